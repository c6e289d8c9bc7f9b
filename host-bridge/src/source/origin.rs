//! Where the daemon's raw frames come from, as the configuration writes it.

use core::fmt;
use core::str::FromStr;
use std::path::PathBuf;

use super::address::Address;

/// Where raw frames come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// `tcp://HOST:PORT`, `unix:PATH`, `serial:PATH[@BAUD]`
    Line(Address),
    /// `replay:RECORDING`
    Recording(PathBuf),
    /// `iceoryx2:SERVICE`
    SharedMemory(String),
    /// `epics:PLAN.toml`
    Epics(PathBuf),
}

impl FromStr for Origin {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once(':').filter(|(_, rest)| !rest.is_empty()) {
            Some(("replay", path)) => Ok(Self::Recording(path.into())),
            Some(("epics", plan)) => Ok(Self::Epics(plan.into())),
            Some(("iceoryx2", service)) => Ok(Self::SharedMemory(service.to_owned())),
            _ => text.parse().map(Self::Line),
        }
    }
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(address) => address.fmt(f),
            Self::Recording(path) => write!(f, "replay:{}", path.display()),
            Self::SharedMemory(service) => write!(f, "iceoryx2:{service}"),
            Self::Epics(plan) => write!(f, "epics:{}", plan.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_come_from_lines_recordings_or_shared_memory() {
        for text in [
            "tcp://localhost:5000",
            "unix:/run/a",
            "serial:/dev/ttyS1@115200",
            "replay:night",
            "iceoryx2:a/b",
            "epics:p.toml",
        ] {
            assert_eq!(text.parse::<Origin>().unwrap().to_string(), text);
        }
        assert_eq!("replay:night".parse(), Ok(Origin::Recording("night".into())));
        for wrong in ["replay:", "iceoryx2:", "epics:", "night", "serial:"] {
            assert!(wrong.parse::<Origin>().is_err(), "{wrong}");
        }
    }
}
