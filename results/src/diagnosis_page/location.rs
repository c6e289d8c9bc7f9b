//! The location of an unmodelled discrepancy in two or three words.

use diagnosis::{Data, Linear, Location};
use twin::Plane;

/// Names a location.
pub fn short(at: &Location, data: &Data) -> String {
    let name = at.label(data);
    match at {
        Location::Monitor(_) => format!("monitor {name}"),
        Location::MonitorInTime(_) => format!("monitor {name}, in time"),
        Location::GainInTime(_) => format!("gain of {name} in time"),
        Location::MonitorElsewhere(_) => format!("monitor {name}, other location"),
        Location::MonitorCurve(_) => format!("curve of {name}"),
        Location::Corrector(_) => format!("corrector {name}"),
        Location::CorrectorElsewhere(_) => format!("corrector {name}, other location"),
        Location::UnsteadyCorrector(_) => format!("corrector {name}, from frame to frame"),
        Location::Ring(_, Plane::X) => format!("kicks near {name}, x"),
        Location::Ring(_, Plane::Y) => format!("kicks near {name}, y"),
        Location::RingInTime(_, Plane::X) => format!("kicks near {name} in time, x"),
        Location::RingInTime(_, Plane::Y) => format!("kicks near {name} in time, y"),
        Location::Linear(_, does) => format!("unknown element near {name}, {}", does_what(*does)),
        Location::QuadrupoleInTime(_) => format!("quadrupole {name}, in time"),
        Location::QuadrupoleInRuns(_) => format!("quadrupole {name}, from setting to setting"),
        Location::Time => "all monitors, in time".into(),
        Location::Tunes => "tunes, in time".into(),
        Location::Everywhere => "all monitors".into(),
        Location::FirstFrames { .. } => format!("first frames of settings, {name}"),
        Location::FrameToFrame => "all monitors, from frame to frame".into(),
    }
}

fn does_what(element: Linear) -> &'static str {
    match element {
        Linear::Focuses => "focusing",
        Linear::Couples => "coupling",
        Linear::FocusesAndCouples => "focusing and coupling",
        Linear::Turns => "turning",
    }
}
