//! Set points of the orbit feedback in shared memory: one record a frame; the last one is there for whoever joins.

use core::fmt::Display;

use iceoryx2::port::{publisher, subscriber};
use iceoryx2::prelude::{Node, ZeroCopySend, ipc};
use iceoryx2::service::port_factory::publish_subscribe;
use inference::stream::Correction;

use super::services::{NODES, join, joined};
use super::{PUBLISHERS, PublishError, SUBSCRIBERS, now_ns};

/// What the set points of a service of estimates are called: its name, and this.
const SUFFIX: &str = "/setpoints";
/// Records that wait for a slow reader.
const BUFFER: usize = 16;

/// What holds for a whole record; see the table in `docs/daemon.md`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("orbitcal.Setpoints.v1")]
#[allow(missing_docs)] // the table
pub struct SetpointHeader {
    pub published_ns: u64,
    pub sequence: u32,
    pub frames: u32,
    pub hold: u32,
    pub left_out: u32,
    pub limited: u32,
    pub correctors: u32,
    pub text_bytes: u32,
    pub reserved: u32,
}

/// Set points as a reader has them.
#[derive(Debug, Clone, PartialEq)]
pub struct Setpoints {
    /// What holds for all of them.
    pub header: SetpointHeader,
    /// Currents [A], one a corrector.
    pub current: Vec<f32>,
    /// What each corrector is to the feedback: [`inference::stream::Role`] as a number.
    pub role: Vec<u32>,
}

/// Service of the set points, and the process that has joined it.
struct Service {
    name: String,
    setpoints: publish_subscribe::PortFactory<ipc::Service, [u32], SetpointHeader>,
    /// Belongs to it: it ends with it.
    _node: Node<ipc::Service>,
}

impl Service {
    fn try_join(estimates: &str, who: &str) -> Result<Self, PublishError> {
        let name = format!("{estimates}{SUFFIX}");
        let (node, service) = joined(&name, who)?;
        let setpoints = node.service_builder(&service).publish_subscribe::<[u32]>().user_header::<SetpointHeader>();
        let setpoints = setpoints.history_size(1).subscriber_max_buffer_size(BUFFER).enable_safe_overflow(true);
        let setpoints = setpoints.max_subscribers(SUBSCRIBERS).max_publishers(PUBLISHERS).max_nodes(NODES);
        let setpoints = setpoints.open_or_create().map_err(|e| join(&name, "set points", &e))?;
        Ok(Self { name, setpoints, _node: node })
    }
}

/// The daemon's end.
pub struct SetpointWriter {
    publisher: publisher::Publisher<ipc::Service, [u32], SetpointHeader>,
    service: Service,
    text: String,
    correctors: usize,
}

impl SetpointWriter {
    /// Join the service beside that of the estimates, or create it, for these correctors of a machine.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(estimates: &str, who: &str, machine: &str, correctors: &[String]) -> Result<Self, PublishError> {
        let service = Service::try_join(estimates, who)?;
        // a name with a line feed in it would be two
        let all = [machine].into_iter().chain(correctors.iter().map(String::as_str));
        let text: String = all.map(|name| name.replace('\n', " ") + "\n").collect();
        let words = 2 * correctors.len() + text.len().div_ceil(4);
        let publisher = service.setpoints.publisher_builder().initial_max_slice_len(words).create();
        let publisher = publisher.map_err(|e| join(&service.name, "publisher", &e))?;
        Ok(Self { publisher, service, text, correctors: correctors.len() })
    }

    /// Publish what a feedback made of a frame: its number, and that of all frames; waits for nobody.
    ///
    /// # Errors
    /// [`PublishError::Send`].
    pub fn publish(&mut self, [sequence, frames]: [u32; 2], correction: &Correction) -> Result<(), PublishError> {
        let service = self.service.name.clone();
        let wrong = |reason: &dyn Display| PublishError::Send { service, sequence, reason: reason.to_string() };
        let text = self.text.as_bytes().chunks(4).map(super::layout::word);
        let current = correction.setpoint.iter().map(|current| current.to_bits());
        let role = correction.role.iter().map(|role| *role as u32);
        let payload: Vec<u32> = current.chain(role).chain(text).collect();
        let header = SetpointHeader {
            published_ns: now_ns(),
            sequence,
            frames,
            hold: correction.steered.hold.map_or(0, |hold| hold.code().into()),
            left_out: correction.steered.left_out.into(),
            limited: correction.steered.limited.into(),
            correctors: self.correctors as u32,
            text_bytes: self.text.len() as u32,
            reserved: 0,
        };
        let mut sample = match self.publisher.loan_slice_uninit(payload.len()) {
            Ok(sample) => sample,
            Err(error) => return Err(wrong(&error)),
        };
        *sample.user_header_mut() = header;
        sample.write_from_slice(&payload).send().map_err(|e| wrong(&e))?;
        Ok(())
    }
}

/// A reader's end.
pub struct SetpointReader {
    subscriber: subscriber::Subscriber<ipc::Service, [u32], SetpointHeader>,
    service: Service,
}

impl SetpointReader {
    /// Join the service beside that of the estimates, or create it.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(estimates: &str) -> Result<Self, PublishError> {
        let service = Service::try_join(estimates, "orbitcal-setpoints")?;
        let subscriber = service.setpoints.subscriber_builder().create();
        let subscriber = subscriber.map_err(|e| join(&service.name, "subscriber", &e))?;
        Ok(Self { subscriber, service })
    }

    /// The newest record that has come since the last call.
    ///
    /// # Errors
    /// [`PublishError::Receive`], also for what is no record.
    pub fn newest(&mut self) -> Result<Option<Setpoints>, PublishError> {
        let wrong = |reason: &dyn Display| PublishError::Receive {
            service: self.service.name.clone(),
            reason: reason.to_string(),
        };
        let mut newest = None;
        while let Some(sample) = self.subscriber.receive().map_err(|e| wrong(&e))? {
            newest = Some(decode(*sample.user_header(), sample.payload()).ok_or_else(|| wrong(&"no record"))?);
        }
        Ok(newest)
    }
}

/// The record of a sample; none if it is too short.
fn decode(header: SetpointHeader, payload: &[u32]) -> Option<Setpoints> {
    let count = header.correctors as usize;
    let (current, role) = (payload.get(..count)?, payload.get(count..count.checked_mul(2)?)?);
    let current = current.iter().map(|word| f32::from_bits(*word)).collect();
    Some(Setpoints { header, current, role: role.to_vec() })
}

#[cfg(test)]
mod tests {
    use estimator::{Hold, Steered};
    use inference::stream::Role;

    use super::*;

    #[test]
    fn whoever_joins_late_gets_the_last_set_points() {
        let service = format!("orbitcal/test/{}/steered", std::process::id());
        let mut writer =
            SetpointWriter::try_new(&service, "a test", "test ring", &["H_A1".into(), "V_A2".into()]).unwrap();
        let correction = |current| Correction {
            steered: Steered { hold: Some(Hold::PutAside), left_out: 1, limited: 2 },
            setpoint: vec![current, -1.5],
            role: vec![Role::Used, Role::LeftOut],
        };
        (1..=3).for_each(|n| writer.publish([n, n], &correction(n as f32)).unwrap());
        let mut reader = SetpointReader::try_new(&service).unwrap();
        writer.publish([7, 4], &correction(4.0)).unwrap();
        let Setpoints { header, current, role } = reader.newest().unwrap().unwrap();
        assert_eq!((current, role), (vec![4.0, -1.5], vec![1, 2]));
        assert_eq!((header.sequence, header.frames, header.hold), (7, 4, 2));
        assert_eq!((header.left_out, header.limited, header.correctors), (1, 2, 2));
        assert_eq!(reader.newest().unwrap(), None);
        assert_eq!(core::mem::size_of::<SetpointHeader>(), 40);
    }
}
