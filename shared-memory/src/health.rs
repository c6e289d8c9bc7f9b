//! Health in shared memory: the last one is there for whoever joins, a new one comes when a state changes, and every second.

use std::sync::Arc;

use estimator::FitQuality;
use iceoryx2::prelude::ZeroCopySend;
use results::Names;

use super::latest::{Reader, Writer};
use super::{Condition, HealthRecord, PublishError, State, now_ns};

/// What the health of a service of estimates is called: its name, and this.
const SUFFIX: &str = "/health";

/// What holds for a whole record; see the table in `docs/daemon.md`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("orbitcal.Health.v1")]
#[allow(missing_docs)] // the table
pub struct HealthHeader {
    pub published_ns: u64,
    pub sequence: u32,
    pub frames: u32,
    pub mismatch: u32,
    pub chi_square: f32,
    pub degrees_of_freedom: f32,
    pub excess: f32,
    pub monitors: u32,
    pub correctors: u32,
    pub text_bytes: u32,
    pub reserved: u32,
}

/// The daemon's end.
pub struct HealthWriter(Writer<HealthHeader>);

impl HealthWriter {
    /// Join the service beside that of the estimates, or create it, for a machine with these monitors and correctors.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(
        estimates: &str,
        who: &str,
        names: &Arc<Names>,
        correctors: &[String],
    ) -> Result<Self, PublishError> {
        let all = [&names.machine].into_iter().chain(&names.monitors).chain(correctors).map(String::as_str);
        let numbers = 4 * (names.monitors.len() + correctors.len());
        Writer::try_new(format!("{estimates}{SUFFIX}"), who, numbers, all).map(Self)
    }

    /// Publish; waits for nobody.
    ///
    /// # Errors
    /// [`PublishError::Send`].
    pub fn publish(&mut self, record: &HealthRecord) -> Result<(), PublishError> {
        let (header, payload) = (self.header(record), self.payload(record));
        self.0.send(record.sequence, header, &payload)
    }

    fn header(&self, record: &HealthRecord) -> HealthHeader {
        HealthHeader {
            published_ns: now_ns(),
            sequence: record.sequence,
            frames: record.frames,
            mismatch: u32::from(record.fit.is_mismatch()),
            chi_square: record.fit.chi_square,
            degrees_of_freedom: record.fit.degrees_of_freedom,
            excess: record.fit.excess(),
            monitors: record.monitors.len() as u32,
            correctors: record.correctors.len() as u32,
            text_bytes: self.0.text_bytes(),
            reserved: 0,
        }
    }

    fn payload(&self, record: &HealthRecord) -> Vec<u32> {
        let all = || record.monitors.iter().chain(&record.correctors);
        let ratio = |which: usize| all().map(move |each| each.ratios[which].to_bits());
        self.0.payload(all().map(|each| each.state as u32).chain((0..3).flat_map(ratio)))
    }
}

/// A reader's end.
pub struct HealthReader(Reader<HealthHeader>);

impl HealthReader {
    /// Join the service beside that of the estimates, or create it.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(estimates: &str) -> Result<Self, PublishError> {
        Reader::try_new(format!("{estimates}{SUFFIX}"), "orbitcal-health").map(Self)
    }

    /// The newest record that has come since the last call.
    ///
    /// # Errors
    /// [`PublishError::Receive`], also for what is no record.
    pub fn newest(&mut self) -> Result<Option<HealthRecord>, PublishError> {
        self.0.newest(decode)
    }

    /// The same with the names of the correctors.
    ///
    /// # Errors
    /// [`PublishError::Receive`], also for what is no record.
    pub fn newest_with_names(&mut self) -> Result<Option<(HealthRecord, Vec<String>)>, PublishError> {
        self.0.newest(|header, payload| {
            let record = decode(header, payload)?;
            let names = correctors(header, payload, record.monitors.len() + record.correctors.len());
            Some((record, names))
        })
    }
}

/// The record of a sample; none if it is too short or has an unknown state.
fn decode(header: &HealthHeader, payload: &[u32]) -> Option<HealthRecord> {
    let [monitors, correctors] = [header.monitors as usize, header.correctors as usize];
    let count = monitors.checked_add(correctors)?;
    let words = payload.get(..count.checked_mul(4)?)?;
    let ratio = |which: usize, i: usize| f32::from_bits(words[(1 + which) * count + i]);
    let condition = |i: usize| {
        let state = State::from_code(words[i])?;
        Some(Condition { state, ratios: [0, 1, 2].map(|which| ratio(which, i)) })
    };
    let mut all: Vec<Condition> = (0..count).map(condition).collect::<Option<_>>()?;
    let correctors = all.split_off(monitors);
    let fit = FitQuality { chi_square: header.chi_square, degrees_of_freedom: header.degrees_of_freedom };
    Some(HealthRecord { sequence: header.sequence, frames: header.frames, fit, monitors: all, correctors })
}

/// Names of the correctors in the text behind the numbers of so many instruments.
fn correctors(header: &HealthHeader, payload: &[u32], instruments: usize) -> Vec<String> {
    let words = payload.get(4 * instruments..).unwrap_or_default();
    let mut text: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    text.truncate(header.text_bytes as usize);
    let text = String::from_utf8_lossy(&text);
    text.lines().skip(1 + header.monitors as usize).map(str::to_owned).collect()
}

#[cfg(test)]
mod tests {
    use results::EstimateRecord;

    use super::*;

    #[test]
    fn whoever_joins_late_gets_the_last_record() {
        let service = format!("orbitcal/test/{}/ill", std::process::id());
        let names = EstimateRecord::example(2, 3).names;
        let mut writer = HealthWriter::try_new(&service, "a test", &names, &["H_A1".into()]).unwrap();
        let condition = |state, ratio| Condition { state, ratios: [ratio, 0.5, 0.25] };
        let record = |sequence| HealthRecord {
            sequence,
            frames: 7,
            fit: FitQuality { chi_square: 120.0, degrees_of_freedom: 50.0 },
            monitors: [State::Ok, State::Noisy, State::Back].map(|state| condition(state, 1.5)).to_vec(),
            correctors: vec![condition(State::Dead, 2.0)],
        };
        (1..=3).for_each(|sequence| writer.publish(&record(sequence)).unwrap());
        let mut reader = HealthReader::try_new(&service).unwrap();
        writer.publish(&record(4)).unwrap();
        assert_eq!(reader.newest_with_names().unwrap(), Some((record(4), vec!["H_A1".to_owned()])));
        assert_eq!(reader.newest().unwrap(), None);
        assert_eq!(core::mem::size_of::<HealthHeader>(), 48);
        let payload = writer.payload(&record(4));
        let text: Vec<u8> = payload[16..].iter().flat_map(|word| word.to_le_bytes()).collect();
        assert!(text.starts_with(b"test ring\nM0\nM1\nM2\nH_A1\n"));
    }
}
