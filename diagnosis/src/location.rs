//! Locations of an unmodelled discrepancy, and their descriptions.

use twin::{Plane, Ring, Site};

use super::data::Data;
use super::element::Linear;
use super::term::Term;

/// Location of an unmodelled discrepancy.
#[derive(Debug, Clone, PartialEq)]
pub enum Location {
    /// A monitor, one amplitude a setting.
    Monitor(usize),
    /// A monitor, one amplitude a stretch of time.
    MonitorInTime(usize),
    /// A monitor's gain, in time.
    GainInTime(usize),
    /// A monitor that responds to the orbit at another location: a sum of position and slope in both planes.
    MonitorElsewhere(usize),
    /// A monitor whose reading is a nonlinear function of the position.
    MonitorCurve(usize),
    /// At a corrector.
    Corrector(usize),
    /// A corrector that kicks the beam at a second location as well.
    CorrectorElsewhere(usize),
    /// A corrector whose kick differs from frame to frame of a setting; it competes with what else passes within them.
    UnsteadyCorrector(usize),
    /// A place in the ring (a quadrupole's entrance) where the beam is kicked in a plane.
    Ring(usize, Plane),
    /// The same, in time.
    RingInTime(usize, Plane),
    /// A place in the ring (a quadrupole's entrance) with a linear element that is unknown.
    Linear(usize, Linear),
    /// A quadrupole that changes in time, and as the beam is off its axis kicks it.
    QuadrupoleInTime(usize),
    /// A quadrupole whose gradient differs from run to run of the settings.
    QuadrupoleInRuns(usize),
    /// All monitors, in time.
    Time,
    /// The tunes, in time.
    Tunes,
    /// All monitors, one amplitude a setting each.
    Everywhere,
    /// All monitors, in the first frames of settings, a share of the former orbit; it competes with what else passes within them.
    FirstFrames {
        /// First frame of a stretch of the campaign.
        from: usize,
        /// Its last frame.
        to: usize,
    },
    /// A pattern that all monitors share, from frame to frame: of the noise, so that it competes with none of the others.
    FrameToFrame,
}

impl Location {
    /// The name of the place: a monitor, a corrector, the label of a quadrupole, or a stretch.
    pub fn label(&self, data: &Data) -> String {
        let ring = &data.ring;
        match *self {
            Self::Monitor(b)
            | Self::MonitorInTime(b)
            | Self::GainInTime(b)
            | Self::MonitorElsewhere(b)
            | Self::MonitorCurve(b) => ring.monitor_names()[b].clone(),
            Self::Corrector(c) | Self::CorrectorElsewhere(c) | Self::UnsteadyCorrector(c) => {
                ring.corrector_names()[c].clone()
            }
            Self::Ring(q, _)
            | Self::RingInTime(q, _)
            | Self::Linear(q, _)
            | Self::QuadrupoleInTime(q)
            | Self::QuadrupoleInRuns(q) => ring.label(ring.quadrupoles[q].element).to_owned(),
            Self::Time => "time".into(),
            Self::Tunes => "tunes".into(),
            Self::Everywhere => "everywhere".into(),
            Self::FirstFrames { from, to } => format!("frames {from} to {to}"),
            Self::FrameToFrame => "frame to frame".into(),
        }
    }

    /// As a clause of the sentence.
    pub fn phrase(&self, data: &Data) -> String {
        let name = self.label(data);
        match self {
            Self::Monitor(_) => format!("monitor {name} does not follow the orbit"),
            Self::MonitorInTime(_) => format!("monitor {name} changes with time"),
            Self::GainInTime(_) => format!("the gain of monitor {name} changes with time"),
            Self::MonitorElsewhere(_) => format!("monitor {name} responds to the orbit at another location"),
            Self::MonitorCurve(_) => format!("monitor {name} reads a nonlinear function of the position"),
            Self::Corrector(_) => format!("corrector {name} acts otherwise than by a single kick"),
            Self::CorrectorElsewhere(_) => format!("corrector {name} kicks the beam at another location too"),
            Self::UnsteadyCorrector(_) => {
                format!("the kick of corrector {name} differs from frame to frame of a setting")
            }
            Self::Ring(_, Plane::X) => format!("the beam is kicked horizontally near {name}"),
            Self::Ring(_, Plane::Y) => format!("the beam is kicked vertically near {name}"),
            Self::RingInTime(_, Plane::X) => format!("a horizontal kick near {name} changes during the campaign"),
            Self::RingInTime(_, Plane::Y) => format!("a vertical kick near {name} changes during the campaign"),
            Self::Linear(_, does) => format!("an unknown element near {name} {}", does.phrase()),
            Self::QuadrupoleInTime(_) => format!("the focusing near {name} changes during the campaign"),
            Self::QuadrupoleInRuns(_) => format!("the focusing near {name} changes from setting to setting"),
            Self::Time => "the orbit changes with time at many monitors".into(),
            Self::Tunes => "the tunes change during the campaign".into(),
            Self::Everywhere => {
                "the readings of all monitors scatter more between settings than between repeats".into()
            }
            Self::FirstFrames { .. } => {
                format!(
                    "the first frames of settings keep a share of the former orbit ({name}), as if all correctors settled slowly or \
                     readings were averaged over cycles"
                )
            }
            Self::FrameToFrame => data.noise.frame_to_frame.as_ref().map_or(name, |one| one.phrase(&data.ring)),
        }
    }

    /// True if an effect of the library describes the same instrument, in part: one that does something unknown has seldom a second fault.
    pub fn holds(&self, term: &Term, ring: &Ring) -> bool {
        match *self {
            Self::Monitor(b) | Self::GainInTime(b) | Self::MonitorElsewhere(b) | Self::MonitorCurve(b) => {
                term.kind.is_of_a_monitor() && term.site == Site::Monitor(ring.read_monitors[b])
            }
            Self::Corrector(c) | Self::CorrectorElsewhere(c) | Self::UnsteadyCorrector(c) => {
                term.kind.is_of_a_corrector() && term.site == Site::Corrector(c)
            }
            _ => false,
        }
    }

    /// Position along the beam [m].
    pub fn position(&self, data: &Data) -> Option<f64> {
        let ring = &data.ring;
        let at = match *self {
            Self::Monitor(b)
            | Self::MonitorInTime(b)
            | Self::GainInTime(b)
            | Self::MonitorElsewhere(b)
            | Self::MonitorCurve(b) => ring.monitors[ring.read_monitors[b]].element,
            Self::Corrector(c) | Self::CorrectorElsewhere(c) | Self::UnsteadyCorrector(c) => ring.correctors[c].element,
            Self::Ring(q, _)
            | Self::RingInTime(q, _)
            | Self::Linear(q, _)
            | Self::QuadrupoleInTime(q)
            | Self::QuadrupoleInRuns(q) => ring.quadrupoles[q].element,
            Self::FrameToFrame => data.noise.frame_to_frame.as_ref()?.element(ring)?,
            Self::Time | Self::Tunes | Self::Everywhere | Self::FirstFrames { .. } => return None,
        };
        Some(ring.elements[at].s)
    }
}
