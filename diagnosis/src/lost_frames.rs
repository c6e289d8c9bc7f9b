//! Frames of which many readings were put aside: their orbit is not that of the other frames of their setting, as where the beam was lost or a
//! corrector tripped. These readings are not in the diagnosis, so that they have to be told.

use estimator::MonitorState;

use super::data::Data;

/// Share of the sound monitors whose readings are put aside in such a frame, and their number at least: few of them jump at once, which says nothing of the
/// beam.
const MANY: f64 = 0.2;
const FEWEST: usize = 3;
/// Frames that are named.
const NAMED: usize = 4;

/// Names the lost frames of a recording, counted from 0, if it has some.
pub fn lost_frames(own: &Data) -> Option<String> {
    let sound = |b: &usize| own.health()[*b].state == MonitorState::Ok;
    let monitors: Vec<usize> = own.active_monitors().into_iter().filter(sound).collect();
    let is_lost = |frame: &usize| {
        let dropped = monitors.iter().filter(|&&b| own.is_aside(*frame, b)).count();
        dropped >= FEWEST && dropped as f64 > MANY * monitors.len() as f64
    };
    let frames: Vec<usize> = (0..own.pools.of_frame.len()).filter(is_lost).collect();
    let named: Vec<String> = frames.iter().take(NAMED).map(usize::to_string).collect();
    let more = if frames.len() > NAMED { ", ..." } else { "" };
    let what = if frames.len() == 1 { "frame" } else { "frames" };
    (!frames.is_empty()).then(|| {
        format!("in {what} {}{more} many readings are not those of the setting, and left out", named.join(", "))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{template, whitened};

    #[test]
    fn a_trip_and_a_lost_beam_are_told() {
        let (ring, recording) = template();
        let data = |recording: &_| whitened(&ring, recording);
        assert_eq!(lost_frames(&data(&recording)), None);
        let mut broken = recording.clone();
        // the orbit of another setting, and none
        let other = broken.rows[120].reading.clone();
        broken.rows[30].reading = other;
        broken.rows[90].reading.iter_mut().enumerate().for_each(|(b, r)| *r = r.map(|_| 1e-3 * (b as f64 - 16.0)));
        // without a beam the electronics read zero
        broken.rows[200].reading.iter_mut().for_each(|r| *r = r.map(|_| 0.0));
        // what was not read is not put aside
        broken.rows[150].reading.fill(None);
        assert_eq!(
            lost_frames(&data(&broken)).as_deref(),
            Some("in frames 30, 90, 200 many readings are not those of the setting, and left out")
        );
    }
}
