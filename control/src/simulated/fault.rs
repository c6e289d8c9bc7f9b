//! What fails in a simulated machine.

use core::str::FromStr;

use inference::recording::Names;
use twin::Ring;
use twin::limits::Range;

/// Something that fails.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    /// A monitor does not report in a share of the cycles.
    DropOut {
        /// Index among the read monitors.
        monitor: usize,
        /// Share.
        share: f64,
    },
    /// The monitors of a plane are not updated from a cycle on.
    Freeze {
        /// 0 horizontal, 1 vertical.
        plane: usize,
        /// First cycle.
        from: u32,
    },
    /// A corrector stays where it is from a cycle on.
    Stick {
        /// Its index.
        corrector: usize,
        /// First cycle.
        from: u32,
    },
}

/// A fault that there is none of.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("expected drop_out@MONITOR=SHARE (0 to 1), freeze@x=CYCLE or stick@CORRECTOR=CYCLE, found {0:?}")]
pub struct FaultError(String);

impl Fault {
    /// `drop_out@x_E4=0.1`, `freeze@y=200`, `stick@A4=300`.
    ///
    /// # Errors
    /// [`FaultError`].
    pub fn parse(text: &str, ring: &Ring) -> Result<Self, FaultError> {
        let names = Names::from_ring(ring);
        let parsed = || {
            let (kind, rest) = text.split_once('@')?;
            let (place, value) = rest.split_once('=')?;
            match kind {
                "drop_out" => Some(Self::DropOut { monitor: names.monitor(place)?, share: SHARE.parse(value).ok()? }),
                "freeze" => {
                    let plane = ["x", "y"].iter().position(|plane| *plane == place)?;
                    Some(Self::Freeze { plane, from: number(value)? })
                }
                "stick" => Some(Self::Stick { corrector: names.corrector(place)?, from: number(value)? }),
                _ => None,
            }
        };
        parsed().ok_or_else(|| FaultError(text.into()))
    }

    /// The monitor that does not report in this cycle.
    pub(super) fn drops(&self, random: &mut impl FnMut() -> f64) -> Option<usize> {
        match self {
            Self::DropOut { monitor, share } if random() < *share => Some(*monitor),
            _ => None,
        }
    }

    /// True if the monitors of a plane are not updated.
    pub(super) fn freezes(&self, of: usize, cycle: u32) -> bool {
        matches!(self, Self::Freeze { plane, from } if *plane == of && cycle >= *from)
    }

    /// True if a corrector stays where it is.
    pub(super) fn sticks(&self, of: usize, cycle: u32) -> bool {
        matches!(self, Self::Stick { corrector, from } if *corrector == of && cycle >= *from)
    }
}

/// Of all cycles.
const SHARE: Range = Range::new(0.0, 1.0, "");

fn number<T: FromStr>(text: &str) -> Option<T> {
    text.parse().ok()
}
