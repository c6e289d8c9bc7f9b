//! The health of monitors and correctors as it is published.

use estimator::FitQuality;
use serde::{Deserialize, Serialize};

/// State of a monitor or a corrector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[repr(u32)]
pub enum State {
    /// As expected.
    #[default]
    Ok = 0,
    /// It scatters more than expected.
    Noisy = 1,
    /// It jumps occasionally.
    Jumps = 2,
    /// It does not report, or does nothing.
    Dead = 3,
    /// Its fault has ended a short while ago.
    Back = 4,
}

impl State {
    /// All of them, in the order of their codes.
    pub const ALL: [Self; 5] = [Self::Ok, Self::Noisy, Self::Jumps, Self::Dead, Self::Back];

    /// The state of a code in shared memory.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.get(code as usize).copied()
    }

    /// In one word.
    pub fn word(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Noisy => "noisy",
            Self::Jumps => "jumps",
            Self::Dead => "dead",
            Self::Back => "back",
        }
    }
}

/// What is published of the health of one monitor or corrector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Condition {
    /// Its state.
    pub state: State,
    /// Filtered scatter, share of jumps, share of missing samples [1].
    pub ratios: [f32; 3],
}

/// Health of the machine after a frame, and the evidence of the mismatch flag.
#[derive(Debug, Clone, PartialEq)]
pub struct HealthRecord {
    /// The frame.
    pub sequence: u32,
    /// Frames so far.
    pub frames: u32,
    /// Readings against the model: chi-square and its degrees of freedom.
    pub fit: FitQuality,
    /// [B]
    pub monitors: Vec<Condition>,
    /// [C]
    pub correctors: Vec<Condition>,
}
