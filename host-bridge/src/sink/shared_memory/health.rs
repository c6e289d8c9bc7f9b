//! Health in shared memory: the last one is there for whoever joins, a new one comes when a state changes, and every second.

use core::fmt::Display;
use std::sync::Arc;

use estimator::FitQuality;
use iceoryx2::port::{publisher, subscriber};
use iceoryx2::prelude::{Node, ZeroCopySend, ipc};
use iceoryx2::service::port_factory::publish_subscribe;

use super::services::{NODES, join, joined};
use super::{PUBLISHERS, PublishError, SUBSCRIBERS, now_ns};
use crate::health::{Condition, HealthRecord, State};
use crate::record::Names;

/// What the health of a service of estimates is called: its name, and this.
const SUFFIX: &str = "/health";
/// Records that wait for a slow reader.
const BUFFER: usize = 16;

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

/// Service of the health, and the process that has joined it.
struct Service {
    name: String,
    health: publish_subscribe::PortFactory<ipc::Service, [u32], HealthHeader>,
    /// Belongs to it: it ends with it.
    _node: Node<ipc::Service>,
}

impl Service {
    fn try_join(estimates: &str, who: &str) -> Result<Self, PublishError> {
        let name = format!("{estimates}{SUFFIX}");
        let (node, service) = joined(&name, who)?;
        let health = node.service_builder(&service).publish_subscribe::<[u32]>().user_header::<HealthHeader>();
        let health = health.history_size(1).subscriber_max_buffer_size(BUFFER).enable_safe_overflow(true);
        let health = health.max_subscribers(SUBSCRIBERS).max_publishers(PUBLISHERS).max_nodes(NODES);
        let health = health.open_or_create().map_err(|e| join(&name, "health", &e))?;
        Ok(Self { name, health, _node: node })
    }
}

/// The daemon's end.
pub struct HealthWriter {
    publisher: publisher::Publisher<ipc::Service, [u32], HealthHeader>,
    service: Service,
    text: String,
}

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
        let service = Service::try_join(estimates, who)?;
        let all = [&names.machine].into_iter().chain(&names.monitors).chain(correctors);
        // a name with a line feed in it would be two
        let text: String = all.map(|name| name.replace('\n', " ") + "\n").collect();
        let words = 4 * (names.monitors.len() + correctors.len()) + text.len().div_ceil(4);
        let publisher = service.health.publisher_builder().initial_max_slice_len(words).create();
        let publisher = publisher.map_err(|e| join(&service.name, "publisher", &e))?;
        Ok(Self { publisher, service, text })
    }

    /// Publish; waits for nobody.
    ///
    /// # Errors
    /// [`PublishError::Send`].
    pub fn publish(&mut self, record: &HealthRecord) -> Result<(), PublishError> {
        let wrong = |reason: &dyn Display| PublishError::Send {
            service: self.service.name.clone(),
            sequence: record.sequence,
            reason: reason.to_string(),
        };
        let payload = self.payload(record);
        let mut sample = self.publisher.loan_slice_uninit(payload.len()).map_err(|e| wrong(&e))?;
        *sample.user_header_mut() = self.header(record);
        sample.write_from_slice(&payload).send().map_err(|e| wrong(&e))?;
        Ok(())
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
            text_bytes: self.text.len() as u32,
            reserved: 0,
        }
    }

    fn payload(&self, record: &HealthRecord) -> Vec<u32> {
        let all = || record.monitors.iter().chain(&record.correctors);
        let ratio = |which: usize| all().map(move |each| each.ratios[which].to_bits());
        let text = self.text.as_bytes().chunks(4).map(super::layout::word);
        all().map(|each| each.state as u32).chain((0..3).flat_map(ratio)).chain(text).collect()
    }
}

/// A reader's end.
pub struct HealthReader {
    subscriber: subscriber::Subscriber<ipc::Service, [u32], HealthHeader>,
    service: Service,
}

impl HealthReader {
    /// Join the service beside that of the estimates, or create it.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(estimates: &str) -> Result<Self, PublishError> {
        let service = Service::try_join(estimates, "orbitcal-health")?;
        let subscriber = service.health.subscriber_builder().create();
        let subscriber = subscriber.map_err(|e| join(&service.name, "subscriber", &e))?;
        Ok(Self { subscriber, service })
    }

    /// The newest record that has come since the last call.
    ///
    /// # Errors
    /// [`PublishError::Receive`], also for what is no record.
    pub fn newest(&mut self) -> Result<Option<HealthRecord>, PublishError> {
        Ok(self.newest_with_names()?.map(|(record, _)| record))
    }

    /// The same with the names of the correctors.
    ///
    /// # Errors
    /// [`PublishError::Receive`], also for what is no record.
    pub fn newest_with_names(&mut self) -> Result<Option<(HealthRecord, Vec<String>)>, PublishError> {
        let mut newest = None;
        while let Some(sample) = self.subscriber.receive().map_err(|e| self.wrong(&e))? {
            let (header, payload) = (sample.user_header(), sample.payload());
            let record = decode(header, payload).ok_or_else(|| self.wrong(&"no record"))?;
            let names = correctors(header, payload, record.monitors.len() + record.correctors.len());
            newest = Some((record, names));
        }
        Ok(newest)
    }

    fn wrong(&self, reason: &dyn Display) -> PublishError {
        PublishError::Receive { service: self.service.name.clone(), reason: reason.to_string() }
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
    use super::*;

    #[test]
    fn whoever_joins_late_gets_the_last_record() {
        let service = format!("orbitcal/test/{}/ill", std::process::id());
        let names = crate::record::tests::record(2, 3).names;
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
