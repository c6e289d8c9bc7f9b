//! Monitors that repeat one value for a part of the recording. The screening puts these readings aside, and the monitor counts in all other frames; one
//! that ends so is dead, and counts nowhere.

use core::ops::Range;

use estimator::MonitorState;

use super::data::Data;

/// Fewest frames that are said.
const FEWEST: usize = 8;
/// Expected number of such parts by chance up to which one is none: readings of a coarse digitiser often repeat.
const CHANCE: f64 = 1e-3;

/// Names the stuck monitors of a recording that are not dead, each with the longest part in which it repeats one value.
pub fn stuck_monitors(own: &Data) -> Vec<String> {
    let names = own.ring.monitor_names();
    // where most monitors repeat their values there was no beam, or no new reading: that is said of the frames
    let monitors: Vec<usize> = (0..own.monitors()).collect();
    let repeats = |frame: usize, b: usize| frame > 0 && own.recorded(frame, b) == own.recorded(frame - 1, b);
    let frames = own.pools.of_frame.len();
    let by_all = |frame: usize| 2 * monitors.iter().filter(|&&b| repeats(frame, b)).count() > monitors.len();
    let alike: Vec<bool> = (0..frames).map(by_all).collect();
    let of_monitor = |&b: &usize| {
        let repeated: Vec<bool> = (0..frames).map(|frame| repeats(frame, b) && !alike[frame]).collect();
        let Range { start, end } = longest(&repeated).filter(|_| own.health()[b].state != MonitorState::Dead)?;
        Some(format!("monitor {} repeats one value in frames {start} to {}", names[b], end - 1))
    };
    monitors.iter().filter_map(of_monitor).collect()
}

/// The longest part in which every frame repeats the one before, if chance makes none as long, judged by how often frames elsewhere do.
fn longest(repeated: &[bool]) -> Option<Range<usize>> {
    let (mut best, mut start) = (0..0, 0);
    for (frame, repeats) in repeated.iter().enumerate() {
        if !repeats {
            start = frame;
        }
        if frame + 1 - start > best.len() {
            best = start..frame + 1;
        }
    }
    let count = |frames: &[bool]| frames.iter().filter(|repeats| **repeats).count();
    let within = best.len().saturating_sub(1);
    let share = (count(repeated) - within + 1) as f64 / (repeated.len() - within + 2) as f64;
    let by_chance = repeated.len() as f64 * share.powf(within as f64);
    (best.len() >= FEWEST && by_chance < CHANCE).then_some(best)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{template, whitened};

    #[test]
    fn a_monitor_that_repeats_a_value_is_told_and_a_lost_beam_is_not_that() {
        let (ring, recording) = template();
        let data = |recording: &_| whitened(&ring, recording);
        assert!(stuck_monitors(&data(&recording)).is_empty());
        let mut broken = recording.clone();
        let value = broken.rows[100].reading[7];
        broken.rows[101..215].iter_mut().for_each(|row| row.reading[7] = value);
        broken.rows[300..312].iter_mut().flat_map(|row| &mut row.reading).for_each(|reading| *reading = Some(0.0));
        let told = stuck_monitors(&data(&broken));
        assert_eq!(told, [format!("monitor {} repeats one value in frames 100 to 214", ring.monitor_names()[7])]);
    }

    #[test]
    fn values_that_often_repeat_are_those_of_a_coarse_digitiser() {
        let mut repeated: Vec<bool> = (0..400).map(|frame| frame % 10 < 8 && frame > 0).collect();
        assert_eq!(longest(&repeated), None, "nine alike, and as many everywhere");
        repeated[100..220].fill(true);
        // frame 99 ends a part, and 220 goes on with the part that it is in
        assert_eq!(longest(&repeated), Some(99..228));
        assert_eq!(longest(&[]), None);
    }
}
