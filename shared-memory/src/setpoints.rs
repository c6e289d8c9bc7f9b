//! Set points of the orbit feedback in shared memory: one record a frame; the last one is there for whoever joins.

use iceoryx2::prelude::ZeroCopySend;
use inference::stream::Correction;

use super::latest::{Reader, Writer};
use super::{PublishError, now_ns};

/// What the set points of a service of estimates are called: its name, and this.
const SUFFIX: &str = "/setpoints";

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

/// The daemon's end.
pub struct SetpointWriter(Writer<SetpointHeader>);

impl SetpointWriter {
    /// Join the service beside that of the estimates, or create it, for these correctors of a machine.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(estimates: &str, who: &str, machine: &str, correctors: &[String]) -> Result<Self, PublishError> {
        let names = [machine].into_iter().chain(correctors.iter().map(String::as_str));
        Writer::try_new(format!("{estimates}{SUFFIX}"), who, 2 * correctors.len(), names).map(Self)
    }

    /// Publish what a feedback made of a frame: its number, and that of all frames; waits for nobody.
    ///
    /// # Errors
    /// [`PublishError::Send`].
    pub fn publish(&mut self, [sequence, frames]: [u32; 2], correction: &Correction) -> Result<(), PublishError> {
        let header = SetpointHeader {
            published_ns: now_ns(),
            sequence,
            frames,
            hold: correction.steered.hold.map_or(0, |hold| hold.code().into()),
            left_out: correction.steered.left_out.into(),
            limited: correction.steered.limited.into(),
            correctors: correction.setpoint.len() as u32,
            text_bytes: self.0.text_bytes(),
            reserved: 0,
        };
        let current = correction.setpoint.iter().map(|current| current.to_bits());
        let payload = self.0.payload(current.chain(correction.role.iter().map(|role| *role as u32)));
        self.0.send(sequence, header, &payload)
    }
}

/// A reader's end.
pub struct SetpointReader(Reader<SetpointHeader>);

impl SetpointReader {
    /// Join the service beside that of the estimates, or create it.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(estimates: &str) -> Result<Self, PublishError> {
        Reader::try_new(format!("{estimates}{SUFFIX}"), "orbitcal-setpoints").map(Self)
    }

    /// The newest record that has come since the last call.
    ///
    /// # Errors
    /// [`PublishError::Receive`], also for what is no record.
    pub fn newest(&mut self) -> Result<Option<Setpoints>, PublishError> {
        self.0.newest(decode)
    }
}

/// The record of a sample; none if it is too short.
fn decode(header: &SetpointHeader, payload: &[u32]) -> Option<Setpoints> {
    let count = header.correctors as usize;
    let (current, role) = (payload.get(..count)?, payload.get(count..count.checked_mul(2)?)?);
    let current = current.iter().map(|word| f32::from_bits(*word)).collect();
    Some(Setpoints { header: *header, current, role: role.to_vec() })
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
