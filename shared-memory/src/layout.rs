//! A record as bytes in shared memory, the same for readers in any language.
//!
#![doc = include_str!("../../docs/shared-memory.md")]

use std::sync::Arc;

use estimator::{MonitorState, Remarks};
use iceoryx2::prelude::ZeroCopySend;
use results::{EstimateRecord, Names, ReadingUse, Remarked};

/// What holds for a whole record; see the module's first table.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("orbitcal.Estimate.v4")]
#[allow(missing_docs)] // the table
pub struct Header {
    pub time_us: u64,
    pub started_ns: u64,
    pub published_ns: u64,
    pub sequence: u32,
    pub frames: u32,
    pub rejected_frames: u32,
    pub linearised: u32,
    pub mismatch: u32,
    pub nis: f32,
    pub log_evidence: f32,
    /// Not a number where there is none.
    pub tune_innovation: [f32; 2],
    pub vars: u32,
    pub monitors: u32,
    pub text_bytes: u32,
    /// Three flags (put aside, baselines moved, unsolved), the slices of work from bit 3 on, and in the upper half 1 more than the
    /// param that was let loose.
    pub remarks: u32,
    pub put_aside_frames: u32,
    pub baselines_moved: u32,
    pub unsolved_frames: u32,
    pub tables: u32,
    pub usable: u32,
}

/// Who published a record, and when.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Stamp {
    /// Name of the publisher.
    pub publisher: Arc<str>,
    /// Its start [ns since 1970]; a new value tells of a restart.
    pub started_ns: u64,
    /// When it published the record [ns since 1970].
    pub published_ns: u64,
}

/// Why a sample holds no record.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LayoutError {
    /// The payload ends too early or too late.
    #[error("{vars} vars, {monitors} monitors and {text_bytes} bytes of names take {expected} words, found {found}")]
    Length {
        /// N of the header.
        vars: u32,
        /// B of the header.
        monitors: u32,
        /// Length of the text.
        text_bytes: u32,
        /// Words that these take.
        expected: usize,
        /// Words that are there.
        found: usize,
    },
    /// The text is no list of names.
    #[error("expected {expected} names in UTF-8, found {found}")]
    Names {
        /// Publisher, machine, vars and monitors.
        expected: usize,
        /// Names that are there.
        found: usize,
    },
    /// A code that stands for nothing.
    #[error("{what} has no code {found}")]
    Code {
        /// Of what.
        what: &'static str,
        /// The code.
        found: u32,
    },
}

/// Words of a payload.
const fn words(vars: usize, monitors: usize, text_bytes: usize) -> usize {
    6 * vars + vars * (vars + 1) / 2 + 4 * monitors + text_bytes.div_ceil(4)
}

/// The names at the end of every record of a publisher and a machine: made once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Text {
    words: Vec<u32>,
    bytes: usize,
}

impl Text {
    /// Of these names.
    pub fn of(publisher: &str, names: &Names) -> Self {
        let all = [publisher, names.machine.as_str()].into_iter();
        let all = all.chain(names.vars.iter().chain(&names.monitors).map(String::as_str));
        // a name with a line feed in it would be two
        let text: String = all.map(|name| name.replace('\n', " ") + "\n").collect();
        Self { words: text.as_bytes().chunks(4).map(word).collect(), bytes: text.len() }
    }

    /// Words of every record that ends in it.
    pub(super) fn words_of(&self, names: &Names) -> usize {
        words(names.vars.len(), names.monitors.len(), self.bytes)
    }
}

/// A record as header and words, with the text of its names and its publisher.
pub fn encode(record: &EstimateRecord, stamp: &Stamp, text: &Text) -> (Header, Vec<u32>) {
    let header = Header {
        time_us: record.time_us,
        started_ns: stamp.started_ns,
        published_ns: stamp.published_ns,
        sequence: record.sequence,
        frames: record.frames,
        rejected_frames: record.rejected_frames,
        linearised: u32::from(record.linearised),
        mismatch: record.mismatch.map_or(2, u32::from),
        nis: record.nis,
        log_evidence: record.log_evidence,
        tune_innovation: record.tune_innovation.map(|tune| tune.unwrap_or(f32::NAN)),
        vars: record.mean.len() as u32,
        monitors: record.reading.len() as u32,
        text_bytes: text.bytes as u32,
        remarks: said(&record.remarks),
        put_aside_frames: record.remarked.put_aside_frames,
        baselines_moved: record.remarked.baselines_moved,
        unsolved_frames: record.remarked.unsolved_frames,
        tables: record.tables.unwrap_or_default(),
        usable: u32::from(record.is_usable()),
    };
    let mut payload = Vec::with_capacity(text.words_of(&record.names));
    let params = [&record.map_params, &record.centre, &record.params_sigma];
    for values in [&record.mean, &record.sigma].into_iter().chain(params) {
        payload.extend(values.iter().map(|value| value.to_bits()));
    }
    payload.extend(record.clipped.iter().map(|clipped| u32::from(*clipped)));
    payload.extend(record.covariance.iter().map(|value| value.to_bits()));
    payload.extend(record.reading.iter().map(|reading| *reading as u32));
    payload.extend(record.monitor_state.iter().map(|state| *state as u32));
    payload.extend(record.monitor_sigma.iter().map(|value| value.to_bits()));
    payload.extend(&record.monitor_rejected);
    payload.extend(&text.words);
    (header, payload)
}

/// Slices beyond these are not told in the word of remarks.
const MOST_SLICES: u32 = 0x1fff;

/// Remarks as bits: three flags, in the upper half 1 more than the param that was let loose, and in between the slices.
fn said(remarks: &Remarks) -> u32 {
    let flags =
        u32::from(remarks.put_aside) | u32::from(remarks.baselines_moved) << 1 | u32::from(remarks.unsolved) << 2;
    let let_loose = remarks.let_loose.map_or(0, |param| u32::from(param) + 1);
    flags | remarks.slices.min(MOST_SLICES) << 3 | let_loose << 16
}

/// Up to four bytes as a word; those that are missing are zero.
pub(super) fn word(bytes: &[u8]) -> u32 {
    let mut all = [0; 4];
    all[..bytes.len()].copy_from_slice(bytes);
    u32::from_le_bytes(all)
}

/// The record of a sample, and who published it; the names of the one before are `known`, and those of this one are from then on.
///
/// # Errors
/// [`LayoutError`] if they do not fit each other, which a publisher of this version does not do.
pub fn decode(
    header: &Header,
    payload: &[u32],
    known: &mut Option<Known>,
) -> Result<(EstimateRecord, Stamp), LayoutError> {
    let &Header { vars, monitors, text_bytes, .. } = header;
    let [n, b, bytes] = [vars, monitors, text_bytes].map(|count| count as usize);
    let (expected, found) = (words(n, b, bytes), payload.len());
    if found != expected {
        return Err(LayoutError::Length { vars, monitors, text_bytes, expected, found });
    }
    let mut words = Words(payload);
    let [mean, sigma, map_params, centre, params_sigma] = [(); 5].map(|()| words.floats(n));
    let clipped = words.take(n).iter().map(|word| *word != 0).collect();
    let covariance = words.floats(n * (n + 1) / 2);
    let reading = words.take(b).iter().map(|code| reading(*code)).collect::<Result<_, _>>()?;
    let monitor_state = words.take(b).iter().map(|code| state(*code)).collect::<Result<_, _>>()?;
    let monitor_sigma = words.floats(b);
    let monitor_rejected = words.take(b).to_vec();
    let (publisher, names) = Known::of(known, words.0, [bytes, n, b])?;
    let record = EstimateRecord {
        names,
        sequence: header.sequence,
        time_us: header.time_us,
        frames: header.frames,
        rejected_frames: header.rejected_frames,
        remarks: remarks(header.remarks),
        remarked: Remarked {
            put_aside_frames: header.put_aside_frames,
            baselines_moved: header.baselines_moved,
            unsolved_frames: header.unsolved_frames,
        },
        tables: Some(header.tables).filter(|digest| *digest != 0),
        linearised: header.linearised != 0,
        mismatch: [Some(false), Some(true)].get(header.mismatch as usize).copied().flatten(),
        nis: header.nis,
        tune_innovation: header.tune_innovation.map(|tune| Some(tune).filter(|tune| !tune.is_nan())),
        log_evidence: header.log_evidence,
        mean,
        sigma,
        map_params,
        centre,
        params_sigma,
        clipped,
        covariance,
        reading,
        monitor_state,
        monitor_sigma,
        monitor_rejected,
    };
    Ok((record, Stamp { publisher, started_ns: header.started_ns, published_ns: header.published_ns }))
}

/// The rest of a payload whose length has been checked.
struct Words<'w>(&'w [u32]);

impl<'w> Words<'w> {
    fn take(&mut self, count: usize) -> &'w [u32] {
        let (taken, rest) = self.0.split_at(count);
        self.0 = rest;
        taken
    }

    fn floats(&mut self, count: usize) -> Vec<f32> {
        self.take(count).iter().map(|word| f32::from_bits(*word)).collect()
    }
}

fn remarks(bits: u32) -> Remarks {
    let [put_aside, baselines_moved, unsolved] = [0, 1, 2].map(|bit| bits >> bit & 1 == 1);
    let let_loose = (bits >> 16).checked_sub(1).and_then(|param| u16::try_from(param).ok());
    Remarks { put_aside, baselines_moved, unsolved, let_loose, slices: bits >> 3 & MOST_SLICES }
}

fn reading(code: u32) -> Result<ReadingUse, LayoutError> {
    let all = [ReadingUse::Absent, ReadingUse::Used, ReadingUse::Rejected];
    all.get(code as usize).copied().ok_or(LayoutError::Code { what: "a reading", found: code })
}

fn state(code: u32) -> Result<MonitorState, LayoutError> {
    let known = u8::try_from(code).ok().and_then(MonitorState::from_code);
    known.ok_or(LayoutError::Code { what: "a monitor's state", found: code })
}

/// Names that were read before: a publisher sends the same ones with every record.
#[derive(Debug, Clone)]
pub struct Known {
    words: Vec<u32>,
    sizes: [usize; 3],
    publisher: Arc<str>,
    names: Arc<Names>,
}

impl Known {
    /// The names in these words, which are of so many bytes, of `n` vars and `b` monitors.
    fn of(known: &mut Option<Self>, words: &[u32], sizes: [usize; 3]) -> Result<(Arc<str>, Arc<Names>), LayoutError> {
        let is_same = |known: &&mut Self| known.sizes == sizes && known.words == words;
        if let Some(known) = known.as_mut().filter(is_same) {
            return Ok((known.publisher.clone(), known.names.clone()));
        }
        let [bytes, n, b] = sizes;
        let (publisher, names) = names(words, bytes, n, b)?;
        let names = Arc::new(names);
        *known = Some(Self { words: words.to_vec(), sizes, publisher: publisher.clone(), names: names.clone() });
        Ok((publisher, names))
    }
}

/// The publisher's name, and those of a ring of `n` vars and `b` monitors.
fn names(words: &[u32], bytes: usize, n: usize, b: usize) -> Result<(Arc<str>, Names), LayoutError> {
    let mut text: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    text.truncate(bytes);
    let text = String::from_utf8_lossy(&text);
    let mut names: Vec<String> = text.lines().map(str::to_owned).collect();
    let (expected, found) = (2 + n + b, names.len());
    if found != expected {
        return Err(LayoutError::Names { expected, found });
    }
    let monitors = names.split_off(2 + n);
    let vars = names.split_off(2);
    let machine = names.pop().expect("there are two left");
    let publisher = names.pop().expect("there is one left");
    Ok((publisher.into(), Names { machine, vars, monitors }))
}

#[cfg(test)]
mod tests {
    use core::mem::{align_of, offset_of, size_of};

    use super::*;

    fn stamp() -> Stamp {
        Stamp { publisher: "control room".into(), started_ns: 7, published_ns: 9 }
    }

    fn encoded(record: &EstimateRecord) -> (Header, Vec<u32>) {
        encode(record, &stamp(), &Text::of("control room", &record.names))
    }

    #[test]
    fn names_that_are_known_are_the_same_and_others_are_read() {
        let mut known = None;
        let mut read = |record: &EstimateRecord| {
            let (header, payload) = encoded(record);
            decode(&header, &payload, &mut known).unwrap().0
        };
        let (one, same, other) = (
            read(&EstimateRecord::example(3, 2)),
            read(&EstimateRecord::example(3, 2)),
            read(&EstimateRecord::example(2, 3)),
        );
        assert!(Arc::ptr_eq(&one.names, &same.names));
        assert_eq!(other.names, EstimateRecord::example(2, 3).names);
    }

    #[test]
    fn the_header_is_the_documented_one() {
        assert_eq!((size_of::<Header>(), align_of::<Header>()), (96, 8));
        macro_rules! stands_at {
            ($($field:ident $offset:literal)*) => {
                $(assert_eq!(offset_of!(Header, $field), $offset, stringify!($field));)*
            };
        }
        stands_at! {
            time_us 0 started_ns 8 published_ns 16 sequence 24 frames 28 rejected_frames 32 linearised 36
            mismatch 40 nis 44 log_evidence 48 tune_innovation 52 vars 60 monitors 64 text_bytes 68
            remarks 72 put_aside_frames 76 baselines_moved 80 unsolved_frames 84 tables 88 usable 92
        }
    }

    #[test]
    fn the_payload_is_the_documented_one() {
        let mut record = EstimateRecord::example(3, 2);
        record.covariance = (0..6).map(|i| i as f32).collect();
        (record.clipped[2], record.monitor_rejected[1]) = (true, 41);
        (record.remarks.put_aside, record.remarks.unsolved, record.remarked.put_aside_frames) = (true, true, 12);
        (record.reading[0], record.monitor_state[1]) = (ReadingUse::Rejected, MonitorState::Jumps);
        let (header, payload) = encoded(&record);
        let at = |field: &str| match field {
            "mean" => 0,
            "clipped" => 5 * 3,
            "covariance" => 6 * 3,
            "reading" => 6 * 3 + 6,
            "monitor_state" => 6 * 3 + 6 + 2,
            "monitor_rejected" => 6 * 3 + 6 + 3 * 2,
            "text" => 6 * 3 + 6 + 4 * 2,
            _ => unreachable!("the fields above"),
        };
        assert_eq!((header.remarks, header.put_aside_frames), (0b101, 12));
        assert_eq!((header.tables, header.usable), (0, 0), "without a solution");
        assert_eq!(payload[at("mean")], 1.0_f32.to_bits());
        assert_eq!(payload[at("clipped")..][..3], [0, 0, 1]);
        assert_eq!(payload[at("covariance") + 2 * 3 / 2 + 1], 4.0_f32.to_bits(), "row 2, column 1");
        assert_eq!(payload[at("reading")..][..2], [2, 1]);
        assert_eq!(payload[at("monitor_state")..][..2], [0, 2]);
        assert_eq!(payload[at("monitor_rejected")..][..2], [0, 41]);
        let text: Vec<u8> = payload[at("text")..].iter().flat_map(|word| word.to_le_bytes()).collect();
        let names = "control room\ntest ring\nV0\nV1\nV2\nM0\nM1\n";
        assert_eq!(header.text_bytes as usize, names.len());
        assert_eq!(&text[..names.len()], names.as_bytes());
        assert!(text[names.len()..].iter().all(|byte| *byte == 0) && text.len() - names.len() < 4);
    }

    #[test]
    fn a_record_of_any_size_survives_shared_memory() {
        for (vars, monitors) in [(0, 0), (1, 2), (20, 20), (48, 33), (260, 500)] {
            let mut record = EstimateRecord::example(vars, monitors);
            (record.mismatch, record.linearised, record.nis, record.time_us) = (None, true, 2.5, 1 << 40);
            record.tables = Some(0xfeed);
            record.tune_innovation = [None, Some(-1e-3)];
            (record.remarks.baselines_moved, record.remarked.unsolved_frames) = (true, 7);
            let (header, payload) = encoded(&record);
            assert_eq!(payload.len(), Text::of(&stamp().publisher, &record.names).words_of(&record.names));
            assert_eq!(decode(&header, &payload, &mut None).unwrap(), (record, stamp()));
        }
    }

    #[test]
    fn what_is_no_record_is_refused_with_its_numbers() {
        let (header, payload) = encoded(&EstimateRecord::example(2, 1));
        let refused = |header: &Header, payload: &[u32]| decode(header, payload, &mut None).unwrap_err().to_string();
        let expected = "2 vars, 1 monitors and 32 bytes of names take 27 words, found 26";
        assert_eq!(refused(&header, &payload[1..]), expected);
        let mut other = payload.clone();
        other[6 * 2 + 3 + 1] = 9;
        assert_eq!(refused(&header, &other), "a monitor's state has no code 9");
        let mut other = payload.clone();
        *other.last_mut().unwrap() = u32::from_le_bytes(*b"\n\n\n\n");
        assert_eq!(refused(&header, &other), "expected 5 names in UTF-8, found 7");
    }
}
