//! Read-backs of correctors against their settings, before any physics: a kick is taken from the read-back, so that one of a frame that was not the
//! setting's gives that frame a kick that the beam did not have.
//!
//! A read-back may be off by a constant. In the frames in which a corrector is set, its read-back is therefore compared with the setting and the median of what
//! it is off in these frames; in the others, with the median of itself. What lies more than half of the largest setting away contradicts: that is
//! halfway between a corrector that is set and one that is not.

use inference::recording::{Recording, Row};
use twin::median;

/// Share of a corrector's largest setting that separates set from not set.
const HALF: f64 = 0.5;
/// Frames that are named.
const NAMED: usize = 3;

/// Names the correctors of a recording whose read-back is another than their setting in some frames, counted from 0; `names` of its correctors.
pub fn contradictions(recording: &Recording, names: &[String]) -> Vec<String> {
    let said = |(c, corrector): (usize, &String)| {
        let (frames, sizes): (Vec<usize>, Vec<f64>) = contradicting(recording, c).into_iter().unzip();
        let largest = sizes.iter().copied().fold(0.0, f64::max);
        let named: Vec<String> = frames.iter().take(NAMED).map(usize::to_string).collect();
        let more = if frames.len() > NAMED { ", ..." } else { "" };
        let plural = if frames.len() == 1 { "" } else { "s" };
        let (count, named) = (frames.len(), named.join(", "));
        (count > 0).then(|| {
            format!(
                "the read-back of corrector {corrector} contradicts its setting in {count} frame{plural} ({named}{more}), by up to {largest:.1} A"
            )
        })
    };
    names.iter().enumerate().filter_map(said).collect()
}

/// The frames in which the read-back of a corrector contradicts its setting, and by how much [A].
fn contradicting(recording: &Recording, corrector: usize) -> Vec<(usize, f64)> {
    let off = |row: &Row| row.corrector_current[corrector] - row.setting(corrector).unwrap_or_default();
    let settings = recording.rows.iter().filter_map(|row| row.setting(corrector));
    let amplitude = settings.fold(0.0, |largest: f64, setting| largest.max(setting.abs()));
    if amplitude == 0.0 {
        return Vec::new();
    }
    let [set, idle] = [true, false].map(|is_set| {
        let alike = recording.rows.iter().filter(|row| row.setting(corrector).is_some() == is_set);
        median(alike.map(off)).unwrap_or_default()
    });
    let size = |row: &Row| (off(row) - if row.setting(corrector).is_some() { set } else { idle }).abs();
    recording.rows.iter().map(size).enumerate().filter(|(_, size)| *size > HALF * amplitude).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::template;

    #[test]
    fn a_read_back_of_the_frame_before_contradicts_where_the_setting_changes() {
        let (ring, mut recording) = template();
        let names = ring.corrector_names();
        assert!(contradictions(&recording, &names).is_empty());
        // off by a constant is no contradiction
        recording.rows.iter_mut().for_each(|row| row.corrector_current[7] += 30.0);
        assert!(contradictions(&recording, &names).is_empty());
        let late = 9;
        let current = |row: &Row| row.setting(late).unwrap_or_default();
        let settings: Vec<f64> = recording.rows.iter().map(current).collect();
        let changes: Vec<usize> = (1..settings.len()).filter(|&i| settings[i] != settings[i - 1]).collect();
        for i in (1..settings.len()).rev() {
            recording.rows[i].corrector_current[late] = recording.rows[i - 1].corrector_current[late];
        }
        let found = contradictions(&recording, &names);
        assert!(found.len() == 1 && found[0].contains(&names[late]), "{found:?}");
        assert!(!changes.is_empty());
        let frames: Vec<usize> = contradicting(&recording, late).into_iter().map(|(frame, _)| frame).collect();
        assert_eq!(frames, changes, "{}", found[0]);
    }
}
