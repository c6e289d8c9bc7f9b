//! Where something without a class may sit, and how to say it.

use twin::Plane;

use super::data::Data;

/// Where something sits.
#[derive(Debug, Clone, PartialEq)]
pub enum Location {
    /// At a monitor, setting by setting.
    Monitor(usize),
    /// At a monitor, as time goes by.
    MonitorInTime(usize),
    /// A monitor's gain, as time goes by.
    GainInTime(usize),
    /// A monitor that reads another sum of position and slope in both planes than its own position.
    MonitorElsewhere(usize),
    /// A monitor that reads another function of its position.
    MonitorCurve(usize),
    /// At a corrector.
    Corrector(usize),
    /// A corrector whose kick is not where it should be, or not all.
    CorrectorElsewhere(usize),
    /// At a place in the ring (a quadrupole's entrance) that kicks the beam in a plane.
    Ring(usize, Plane),
    /// A quadrupole that changes in time.
    QuadrupoleInTime(usize),
    /// All monitors, as time goes by.
    Time,
    /// The tunes, as time goes by.
    Tunes,
    /// Everywhere.
    Everywhere,
}

/// Sorts of places, which share the prior.
pub const SORTS: usize = 12;

impl Location {
    /// The name of the place: a monitor, a corrector, a half-cell, or a stretch.
    pub fn label(&self, data: &Data) -> String {
        let ring = &data.ring;
        match *self {
            Self::Monitor(b)
            | Self::MonitorInTime(b)
            | Self::GainInTime(b)
            | Self::MonitorElsewhere(b)
            | Self::MonitorCurve(b) => ring.monitor_names()[b].clone(),
            Self::Corrector(c) | Self::CorrectorElsewhere(c) => ring.corrector_names()[c].clone(),
            Self::Ring(q, _) | Self::QuadrupoleInTime(q) => ring.var_names()[q].clone(),
            Self::Time => "time".into(),
            Self::Tunes => "tunes".into(),
            Self::Everywhere => "everywhere".into(),
        }
    }

    /// In two or three words.
    pub fn short(&self, data: &Data) -> String {
        let name = self.label(data);
        match self {
            Self::Monitor(_) => format!("monitor {name}"),
            Self::MonitorInTime(_) => format!("monitor {name}, in time"),
            Self::GainInTime(_) => format!("gain of {name} in time"),
            Self::MonitorElsewhere(_) => format!("monitor {name}, elsewhere"),
            Self::MonitorCurve(_) => format!("curve of {name}"),
            Self::Corrector(_) => format!("corrector {name}"),
            Self::CorrectorElsewhere(_) => format!("corrector {name}, elsewhere"),
            Self::Ring(_, Plane::X) => format!("kicks near {name}, x"),
            Self::Ring(_, Plane::Y) => format!("kicks near {name}, y"),
            Self::QuadrupoleInTime(_) => format!("quadrupole {name}, in time"),
            Self::Time => "all monitors, in time".into(),
            Self::Tunes => "tunes, in time".into(),
            Self::Everywhere => "all monitors".into(),
        }
    }

    /// What is said of it.
    pub fn phrase(&self, data: &Data) -> String {
        let name = self.label(data);
        match self {
            Self::Monitor(_) => format!("monitor {name} does not follow the orbit"),
            Self::MonitorInTime(_) => format!("monitor {name} changes with time"),
            Self::GainInTime(_) => format!("the gain of monitor {name} changes with time"),
            Self::MonitorElsewhere(_) => format!("monitor {name} reads something of the orbit elsewhere"),
            Self::MonitorCurve(_) => format!("monitor {name} reads another function of the position"),
            Self::Corrector(_) => format!("corrector {name} does something else than one kick"),
            Self::CorrectorElsewhere(_) => format!("corrector {name} kicks the beam elsewhere too"),
            Self::Ring(_, Plane::X) => format!("something near {name} kicks the beam horizontally"),
            Self::Ring(_, Plane::Y) => format!("something near {name} kicks the beam vertically"),
            Self::QuadrupoleInTime(_) => format!("the focusing near {name} changes during the campaign"),
            Self::Time => "the orbit changes with time at many monitors".into(),
            Self::Tunes => "the tunes change during the campaign".into(),
            Self::Everywhere => {
                "the readings scatter more from setting to setting than from repeat to repeat, everywhere".into()
            }
        }
    }

    /// Where it is along the beam [m].
    pub fn position(&self, data: &Data) -> Option<f64> {
        let ring = &data.ring;
        let at = match *self {
            Self::Monitor(b)
            | Self::MonitorInTime(b)
            | Self::GainInTime(b)
            | Self::MonitorElsewhere(b)
            | Self::MonitorCurve(b) => ring.monitors[ring.read_monitors[b]].element,
            Self::Corrector(c) | Self::CorrectorElsewhere(c) => ring.correctors[c].element,
            Self::Ring(q, _) | Self::QuadrupoleInTime(q) => ring.quadrupoles[q].element,
            Self::Time | Self::Tunes | Self::Everywhere => return None,
        };
        Some(ring.elements[at].s)
    }
}
