//! Frames of which many readings were put aside: their orbit is not that of the other frames of their setting, as where the beam was lost or a
//! corrector tripped. These readings are not in the diagnosis, so that they have to be told.

use core::fmt;

use estimator::MonitorState;

use super::data::Data;

/// Such frames of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LostFrames {
    /// The recording.
    pub recording: String,
    /// The frames, counted from 0.
    pub frames: Vec<usize>,
}

/// Share of the sound monitors whose readings are put aside in such a frame, and their number at least: few of them jump at once, which says nothing of the
/// beam.
const MANY: f64 = 0.2;
const FEWEST: usize = 3;
/// Frames that are named.
const NAMED: usize = 4;

impl LostFrames {
    /// Of each recording that has some.
    pub fn all(data: &Data) -> Vec<Self> {
        data.campaigns().filter_map(Self::in_campaign).collect()
    }

    fn in_campaign(own: &Data) -> Option<Self> {
        let sound = |b: &usize| own.health()[*b].state == MonitorState::Ok;
        let monitors: Vec<usize> = own.active_monitors().into_iter().filter(sound).collect();
        let is_one = |frame: &usize| {
            let dropped = monitors.iter().filter(|&&b| own.is_aside(*frame, b)).count();
            dropped >= FEWEST && dropped as f64 > MANY * monitors.len() as f64
        };
        let frames: Vec<usize> = (0..own.pools.of_frame.len()).filter(is_one).collect();
        (!frames.is_empty()).then(|| Self { recording: own.name.clone(), frames })
    }
}

impl fmt::Display for LostFrames {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let named: Vec<String> = self.frames.iter().take(NAMED).map(usize::to_string).collect();
        let more = if self.frames.len() > NAMED { ", ..." } else { "" };
        let what = if self.frames.len() == 1 { "frame" } else { "frames" };
        write!(f, "in {what} {}{more} many readings are not those of the setting, and left out", named.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use inference::Campaign;

    use super::*;
    use crate::testing::template;

    #[test]
    fn a_trip_and_a_lost_beam_are_told() {
        let (ring, recording) = template();
        let data = |recording: &_| Data::from_campaign(&Campaign::of(&ring, recording).unwrap()).unwrap();
        assert_eq!(LostFrames::all(&data(&recording)), []);
        let mut broken = recording.clone();
        // the orbit of another setting, and none
        let other = broken.rows[120].reading.clone();
        broken.rows[30].reading = other;
        broken.rows[90].reading.iter_mut().enumerate().for_each(|(b, r)| *r = r.map(|_| 1e-3 * (b as f64 - 16.0)));
        // without a beam the electronics read zero
        broken.rows[200].reading.iter_mut().for_each(|r| *r = r.map(|_| 0.0));
        // what was not read is not put aside
        broken.rows[150].reading.fill(None);
        let told = LostFrames::all(&data(&broken));
        assert_eq!(told.len(), 1);
        assert_eq!(
            told[0].to_string(),
            "in frames 30, 90, 200 many readings are not those of the setting, and left out"
        );
    }
}
