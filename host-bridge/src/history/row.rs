//! A row of the history as a line of CSV: plain columns, the last one the CRC-32 of the line before it.

use core::fmt::Write as _;

use crc::{CRC_32_ISO_HDLC, Crc};

use crate::health::State;

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
/// Columns before those of the vars.
const FIRST: [&str; 8] =
    ["time_s", "sequence", "frames", "usable", "mismatch", "chi_square", "degrees_of_freedom", "nis_per_reading"];
/// Name of the last column.
const LAST: &str = "crc32";
/// Most characters of a number, and of the columns before those of the vars and after those of the instruments with their commas.
const NUMBER: u64 = 16;
const REST: u64 = 110;

/// Whose numbers the rows of a file hold.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Columns {
    /// Strength factors (vars) [N].
    pub vars: Vec<String>,
    /// Monitors, then correctors [B + C].
    pub instruments: Vec<String>,
}

/// One estimate of the history.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// When it was published [ms since 1970].
    pub time_ms: u64,
    /// Number of the frame.
    pub sequence: u32,
    /// Frames so far.
    pub frames: u32,
    /// Whether somebody may act on it.
    pub is_usable: bool,
    /// Readings and model have disagreed since the row before.
    pub mismatch: bool,
    /// Chi-square of the readings so far, and its degrees of freedom.
    pub chi_square: [f32; 2],
    /// Normalised innovation squared per reading; not a number where no reading was used.
    pub nis_per_reading: f32,
    /// Mean and standard deviation of each var [N] [1].
    pub vars: Vec<[f32; 2]>,
    /// The worst state of each monitor and corrector since the row before [B + C].
    pub states: Vec<State>,
}

impl Columns {
    /// The first line of a file.
    pub fn header(&self) -> String {
        let vars = self.vars.iter().flat_map(|name| [format!("{name}_mean"), format!("{name}_sigma")]);
        let states = self.instruments.iter().map(|name| format!("{name}_state"));
        let mut line = csv::Writer::from_writer(Vec::new());
        let all = FIRST.map(str::to_owned).into_iter().chain(vars).chain(states).chain([LAST.to_owned()]);
        let written = line.write_record(all.map(|name| name.replace(['\n', '\r'], " ")));
        written.and_then(|()| Ok(line.flush()?)).expect("memory takes any text");
        let bytes = line.into_inner().expect("it was flushed");
        String::from_utf8(bytes).expect("names are UTF-8")
    }

    /// Those of a first line; none if it is no such line.
    pub fn of_header(line: &str) -> Option<Self> {
        let mut reader = csv::ReaderBuilder::new().has_headers(false).from_reader(line.as_bytes());
        let names = reader.records().next()?.ok()?;
        let names: Vec<&str> = names.iter().collect();
        let middle = names.strip_prefix(&FIRST)?.strip_suffix(&[LAST])?;
        let split = middle.iter().position(|name| name.ends_with("_state")).unwrap_or(middle.len());
        let (vars, states) = middle.split_at(split);
        let var = |pair: &[&str]| {
            let [mean, sigma] = pair else { return None };
            let name = mean.strip_suffix("_mean")?;
            (sigma.strip_suffix("_sigma")? == name).then(|| name.to_owned())
        };
        let vars = vars.chunks(2).map(var).collect::<Option<_>>()?;
        let state = |name: &&str| Some(name.strip_suffix("_state")?.to_owned());
        Some(Self { vars, instruments: states.iter().map(state).collect::<Option<_>>()? })
    }

    /// Most bytes of a row.
    pub fn most_bytes(&self) -> u64 {
        REST + 2 * NUMBER * self.vars.len() as u64 + 2 * self.instruments.len() as u64
    }
}

impl Row {
    /// As a line, line feed included.
    pub fn line(&self) -> String {
        let Self { time_ms, sequence, frames, .. } = self;
        let [usable, mismatch] = [self.is_usable, self.mismatch].map(u8::from);
        let mut line = format!("{}.{:03},{sequence},{frames},{usable},{mismatch}", time_ms / 1000, time_ms % 1000);
        let numbers = self.chi_square.iter().chain([&self.nis_per_reading]).chain(self.vars.as_flattened());
        for number in numbers {
            line.push(',');
            push(&mut line, *number);
        }
        for state in &self.states {
            let _ = write!(line, ",{}", *state as u32);
        }
        let crc = CRC.checksum(line.as_bytes());
        let _ = writeln!(line, ",{crc:08x}");
        line
    }

    /// Of a line without its line feed; none if it is damaged, or has other columns.
    pub fn of_line(line: &str, columns: &Columns) -> Option<Self> {
        let (rest, crc) = line.rsplit_once(',')?;
        if crc.len() != 8 || u32::from_str_radix(crc, 16).ok()? != CRC.checksum(rest.as_bytes()) {
            return None;
        }
        let fields: Vec<&str> = rest.split(',').collect();
        let (first, fields) = fields.split_first_chunk::<8>()?;
        let (vars, states) = fields.split_at_checked(2 * columns.vars.len())?;
        let (seconds, millis) = first[0].split_once('.')?;
        let number = |text: &str| text.parse::<f32>().ok();
        let state = |text: &&str| State::from_code(text.parse().ok()?);
        let states: Vec<State> = states.iter().map(state).collect::<Option<_>>()?;
        let vars = vars.chunks(2).map(|pair| Some([number(pair[0])?, number(pair[1])?])).collect::<Option<_>>()?;
        (states.len() == columns.instruments.len()).then_some(())?;
        Some(Self {
            time_ms: 1000 * seconds.parse::<u64>().ok()? + millis.parse::<u64>().ok()?,
            sequence: first[1].parse().ok()?,
            frames: first[2].parse().ok()?,
            is_usable: first[3] == "1",
            mismatch: first[4] == "1",
            chi_square: [number(first[5])?, number(first[6])?],
            nis_per_reading: number(first[7])?,
            vars,
            states,
        })
    }
}

/// A number as briefly as reads back to the same `f32`, in 15 characters at most.
fn push(line: &mut String, number: f32) {
    let is_plain = number == 0.0 || (1e-4..1e7).contains(&number.abs());
    let _ = if is_plain { write!(line, "{number}") } else { write!(line, "{number:e}") };
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub fn columns() -> Columns {
        Columns {
            vars: ["A2", "odd, name"].map(str::to_owned).to_vec(),
            instruments: vec!["x_C6".into(), "H_A4".into()],
        }
    }

    pub fn row(time_ms: u64) -> Row {
        Row {
            time_ms,
            sequence: u32::MAX,
            frames: 7,
            is_usable: true,
            mismatch: false,
            chi_square: [120.5, 118.0],
            nis_per_reading: f32::NAN,
            vars: vec![[0.9567, 0.0039], [-1.175_494_4e-38, f32::MAX]],
            states: vec![State::Noisy, State::Ok],
        }
    }

    #[test]
    fn names_and_numbers_read_back() {
        let columns = columns();
        let header = columns.header();
        assert_eq!(Columns::of_header(header.trim_end()), Some(columns.clone()), "{header}");
        assert_eq!(Columns::of_header("time_s,crc32"), None);
        let line = row(1_764_025_200_007).line();
        assert!(
            line.starts_with("1764025200.007,4294967295,7,1,0,120.5,118,NaN,0.9567,0.0039,-1.1754944e-38,"),
            "{line}"
        );
        let read = Row::of_line(line.trim_end(), &columns).unwrap();
        assert!(read.nis_per_reading.is_nan());
        assert_eq!(Row { nis_per_reading: 0.0, ..read }, Row { nis_per_reading: 0.0, ..row(1_764_025_200_007) });
    }

    /// Every number of characters that `f32` has.
    #[test]
    fn no_row_is_longer_than_is_promised() {
        let mut bits = 0x3f80_0001_u32;
        for _ in 0..10_000 {
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let mut text = String::new();
            push(&mut text, f32::from_bits(bits));
            assert!((text.len() as u64) < NUMBER, "{text}");
            let (read, number) = (text.parse::<f32>().unwrap(), f32::from_bits(bits));
            assert!(read.to_bits() == number.to_bits() || read.is_nan() && number.is_nan(), "{text}");
        }
        let longest = Row {
            frames: u32::MAX,
            chi_square: [-f32::MIN_POSITIVE; 2],
            nis_per_reading: -f32::MIN_POSITIVE,
            vars: vec![[-f32::MIN_POSITIVE; 2]; 2],
            ..row(99_999_999_999_999)
        };
        assert!(longest.line().len() as u64 <= columns().most_bytes(), "{}", longest.line());
    }

    #[test]
    fn no_changed_byte_is_read() {
        let (line, columns) = (row(5).line(), columns());
        let line = line.trim_end();
        for at in 0..line.len() {
            let mut bytes = line.as_bytes().to_vec();
            bytes[at] ^= 1;
            let changed = String::from_utf8_lossy(&bytes).into_owned();
            assert_eq!(Row::of_line(&changed, &columns), None, "{changed}");
            assert_eq!(Row::of_line(&line[..at], &columns), None, "cut at {at}");
        }
    }
}
