//! Where a device is, as it is written on the command line.

use core::fmt;
use core::str::FromStr;

/// Rate of a serial line where none is given [baud].
const BAUD: u32 = 921_600;

/// Where a device is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Address {
    /// `tcp://HOST:PORT`
    Tcp(String),
    /// `unix:PATH`
    Unix(String),
    /// `serial:PATH[@BAUD]`
    Serial(String, u32),
}

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("expected tcp://HOST:PORT, unix:PATH or serial:PATH[@BAUD], found {text:?}");
        let (scheme, rest) = text.split_once(':').filter(|(_, rest)| !rest.is_empty()).ok_or_else(wrong)?;
        match scheme {
            "tcp" => match rest.strip_prefix("//") {
                Some(address) if address.contains(':') => Ok(Self::Tcp(address.to_owned())),
                _ => Err(wrong()),
            },
            "unix" => Ok(Self::Unix(rest.to_owned())),
            "serial" => {
                let (path, baud) = rest.split_once('@').unwrap_or((rest, ""));
                let baud = if baud.is_empty() { Ok(BAUD) } else { baud.parse().map_err(|_| wrong()) };
                Ok(Self::Serial(path.to_owned(), baud?))
            }
            _ => Err(wrong()),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => write!(f, "tcp://{address}"),
            Self::Unix(path) => write!(f, "unix:{path}"),
            Self::Serial(path, baud) => write!(f, "serial:{path}@{baud}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_are_tcp_unix_or_serial() {
        assert_eq!("tcp://localhost:5000".parse(), Ok(Address::Tcp("localhost:5000".into())));
        assert_eq!("unix:/run/device".parse(), Ok(Address::Unix("/run/device".into())));
        assert_eq!("serial:/dev/ttyACM0".parse(), Ok(Address::Serial("/dev/ttyACM0".into(), 921_600)));
        assert_eq!("serial:/dev/ttyS1@115200".parse(), Ok(Address::Serial("/dev/ttyS1".into(), 115_200)));
        for wrong in ["", "tcp:localhost:5000", "tcp://localhost", "unix:", "serial:/dev/ttyS1@fast", "usb:1"] {
            let error = wrong.parse::<Address>().unwrap_err();
            assert!(error.ends_with(&format!("found {wrong:?}")), "{error}");
        }
        let shown = "serial:/dev/ttyS1@115200";
        assert_eq!(shown.parse::<Address>().unwrap().to_string(), shown);
    }
}
