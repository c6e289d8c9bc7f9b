//! What a measurement asks of a control system.

use serde::Deserialize;

/// A control system: values by the names of their channels.
pub trait Control {
    /// What is known of some channels, in their order.
    ///
    /// # Errors
    /// [`ControlError::Process`]; a channel that is not there is no error.
    fn describe(&mut self, names: &[&str]) -> Result<Vec<Channel>, ControlError>;

    /// Present value of each of some channels, in their order, or what the control system says instead.
    ///
    /// # Errors
    /// [`ControlError::Process`].
    fn sample(&mut self, names: &[&str]) -> Result<Vec<Result<Sample, String>>, ControlError>;

    /// Present values of some channels, in their order.
    ///
    /// # Errors
    /// [`ControlError::Silent`] if one has none.
    fn read(&mut self, names: &[&str]) -> Result<Vec<Sample>, ControlError> {
        let sampled = self.sample(names)?;
        let others = sampled.iter().filter(|one| one.is_err()).count().saturating_sub(1);
        let silent = |(name, one): (&&str, Result<Sample, String>)| {
            one.map_err(|why| ControlError::Silent { channel: (*name).into(), others, why })
        };
        names.iter().zip(sampled).map(silent).collect()
    }

    /// Write one number.
    ///
    /// # Errors
    /// [`ControlError::Refused`] if it was not taken.
    fn write(&mut self, name: &str, value: f64) -> Result<(), ControlError>;

    /// Time of a steady clock [s].
    fn now(&self) -> f64;

    /// Let time pass [s].
    fn pause(&mut self, seconds: f64);
}

/// What is known of a channel before it is used.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Channel {
    /// It answers.
    pub connected: bool,
    /// It may be read.
    pub readable: bool,
    /// It may be written.
    pub writable: bool,
    /// Numbers that it holds.
    pub count: usize,
    /// Smallest and largest number that it takes, in its own unit; none where it states none.
    pub limits: Option<[f64; 2]>,
}

/// A value with its time.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Sample {
    /// One number, or those of a waveform; none for what is no number.
    pub value: Vec<Option<f64>>,
    /// Time stamp [s since 1970].
    pub time_s: f64,
    /// The control system calls it invalid.
    pub invalid: bool,
}

impl Sample {
    /// The number of a channel that holds one.
    pub fn number(&self) -> Option<f64> {
        self.value.first().copied().flatten().filter(|_| !self.invalid)
    }
}

/// Why a channel could not be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ControlError {
    /// Some channels have no value at present; a connection may come back.
    #[error("no value of {channel}{}: {why}", if *others > 0 { format!(" and {others} more") } else { String::new() })]
    Silent {
        /// The first of them.
        channel: String,
        /// How many more there are.
        others: usize,
        /// What the control system says.
        why: String,
    },
    /// A value was not taken.
    #[error("{channel} does not take {value}: {why}")]
    Refused {
        /// Where it was written.
        channel: String,
        /// The value.
        value: f64,
        /// What the control system says.
        why: String,
    },
    /// The process that speaks to the control system is gone.
    #[error("{0}")]
    Process(String),
}
