//! Read-backs of correctors against their settings, before any physics: a kick is taken from the read-back, so that one of a frame that was not the
//! setting's gives that frame a kick that the beam did not have.
//!
//! A read-back may be off by a constant. In the frames in which a corrector is set, its read-back is therefore compared with the setting and the median of what
//! it is off in these frames; in the others, with the median of itself. What lies more than half of the largest setting away contradicts: that is
//! halfway between a corrector that is set and one that is not.

use core::fmt;

use inference::recording::Recording;

/// Share of a corrector's largest setting that separates set from not set.
const HALF: f64 = 0.5;
/// Frames that are named.
const NAMED: usize = 3;

/// A corrector whose read-back is another than its setting in some frames.
#[derive(Debug, Clone, PartialEq)]
pub struct Contradiction {
    /// The recording.
    pub recording: String,
    /// Name of the corrector.
    pub corrector: String,
    /// The frames, counted from 0.
    pub frames: Vec<usize>,
    /// Largest difference [A].
    pub largest: f64,
}

impl Contradiction {
    /// Those of a recording, by corrector; `names` of its correctors.
    pub fn all(recording: &Recording, names: &[String]) -> Vec<Self> {
        (0..names.len()).filter_map(|c| Self::find(recording, c, &names[c])).collect()
    }

    fn find(recording: &Recording, corrector: usize, name: &str) -> Option<Self> {
        let off = |row: &inference::recording::Row| {
            row.corrector_current[corrector] - row.setting(corrector).unwrap_or_default()
        };
        let settings = recording.rows.iter().filter_map(|row| row.setting(corrector));
        let amplitude = settings.fold(0.0, |largest: f64, setting| largest.max(setting.abs()));
        if amplitude == 0.0 {
            return None;
        }
        let usual = [true, false].map(|is_set| {
            let alike = recording.rows.iter().filter(|row| row.setting(corrector).is_some() == is_set);
            median(alike.map(off).collect())
        });
        let differences = recording.rows.iter().map(|row| {
            let [set, idle] = usual;
            (off(row) - if row.setting(corrector).is_some() { set } else { idle }).abs()
        });
        let (frames, sizes): (Vec<usize>, Vec<f64>) =
            differences.enumerate().filter(|(_, size)| *size > HALF * amplitude).unzip();
        let largest = sizes.iter().copied().fold(0.0, f64::max);
        let (recording, corrector) = (recording.name.clone(), name.to_owned());
        (!frames.is_empty()).then_some(Self { recording, corrector, frames, largest })
    }
}

impl fmt::Display for Contradiction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { corrector, frames, largest, .. } = self;
        let named: Vec<String> = frames.iter().take(NAMED).map(usize::to_string).collect();
        let more = if frames.len() > NAMED { ", ..." } else { "" };
        let plural = if frames.len() == 1 { "" } else { "s" };
        let (count, named) = (frames.len(), named.join(", "));
        write!(
            f,
            "the read-back of corrector {corrector} contradicts its setting in {count} frame{plural} ({named}{more}), by up to {largest:.1} A"
        )
    }
}

/// Median, 0 of none.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::template;

    #[test]
    fn a_read_back_of_the_frame_before_contradicts_where_the_setting_changes() {
        let (ring, mut recording) = template();
        let names = ring.corrector_names();
        assert_eq!(Contradiction::all(&recording, &names), []);
        // off by a constant is no contradiction
        recording.rows.iter_mut().for_each(|row| row.corrector_current[7] += 30.0);
        assert_eq!(Contradiction::all(&recording, &names), []);
        let late = 9;
        let current = |row: &inference::recording::Row| row.setting(late).unwrap_or_default();
        let settings: Vec<f64> = recording.rows.iter().map(current).collect();
        let changes: Vec<usize> = (1..settings.len()).filter(|&i| settings[i] != settings[i - 1]).collect();
        for i in (1..settings.len()).rev() {
            recording.rows[i].corrector_current[late] = recording.rows[i - 1].corrector_current[late];
        }
        let found = Contradiction::all(&recording, &names);
        assert_eq!((found.len(), &found[0].corrector), (1, &names[late]));
        assert!(!changes.is_empty());
        assert_eq!(found[0].frames, changes, "{}", found[0]);
    }
}
