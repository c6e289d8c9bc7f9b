//! The settings of a campaign: frames with the same kicks and RF offset, by their read-backs.

use super::drive::Drive;

/// Settings of frames.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Setting of each frame; none of a frame in which several things were moved and that no other repeats.
    pub of_frame: Vec<Option<usize>>,
    /// Of each frame the corrector that alone is moved in it.
    pub corrector: Vec<Option<usize>>,
    /// How many there are.
    pub count: usize,
}

/// What is moved in a frame: powered correctors with their kicks, and the RF; and which of the times in the cycle it has.
#[derive(Debug)]
struct Moved {
    time: usize,
    kicks: Vec<(usize, f64)>,
    rf_offset: f64,
}

/// Share of the largest kick above which a corrector counts as powered: idle ones scatter by a thousandth.
const POWERED: f64 = 0.05;
/// Kicks this close belong to the same setting, as a share of the kick.
const SAME_KICK: f64 = 1.0 / 16.0;
/// RF offsets this close belong to the same setting.
const SAME_OFFSET: f64 = 1e-6;

impl Settings {
    /// Group frames, each with its time in the cycle; `largest` is the largest kick that a corrector was set to [rad].
    pub fn of(drives: &[Drive], times: &[usize], largest: f64) -> Self {
        let mut settings: Vec<(Moved, usize)> = Vec::new();
        let mut index = |(drive, time): (&Drive, &usize)| {
            let moved = Moved::of(drive, *time, POWERED * largest);
            let at = settings.iter().position(|(known, _)| known.is_repeated_by(&moved)).unwrap_or_else(|| {
                settings.push((moved, 0));
                settings.len() - 1
            });
            settings[at].1 += 1;
            at
        };
        let of_frame: Vec<usize> = drives.iter().zip(times).map(&mut index).collect();
        let corrector = |at: &usize| settings[*at].0.only_corrector();
        let alone = |at: &usize| settings[*at].1 == 1 && settings[*at].0.things() > 1;
        Self {
            corrector: of_frame.iter().map(corrector).collect(),
            of_frame: of_frame.iter().map(|at| (!alone(at)).then_some(*at)).collect(),
            count: settings.len(),
        }
    }
}

impl Moved {
    fn of(drive: &Drive, time: usize, powered: f64) -> Self {
        let kicks = drive.kick.iter().copied().enumerate().filter(|(_, kick)| kick.abs() > powered);
        Self { time, kicks: kicks.collect(), rf_offset: drive.rf_offset }
    }

    /// How many things are moved.
    fn things(&self) -> usize {
        self.kicks.len() + usize::from(self.rf_offset.abs() > SAME_OFFSET)
    }

    fn only_corrector(&self) -> Option<usize> {
        (self.things() == 1).then(|| self.kicks.first().map(|(corrector, _)| *corrector)).flatten()
    }

    fn is_repeated_by(&self, other: &Self) -> bool {
        let same = |((one, kick), (another, again)): (&(usize, f64), &(usize, f64))| {
            one == another && (kick - again).abs() <= SAME_KICK * kick.abs().max(again.abs())
        };
        self.time == other.time
            && self.kicks.len() == other.kicks.len()
            && self.kicks.iter().zip(&other.kicks).all(same)
            && (self.rf_offset - other.rf_offset).abs() <= SAME_OFFSET
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;

    use super::*;

    fn frame(kicks: [f64; 3], rf_offset: f64) -> Drive {
        Drive { kick: DVector::from_column_slice(&kicks) * 1e-4, strength: DVector::zeros(0), rf_offset }
    }

    #[test]
    fn frames_are_grouped_by_corrector_sign_size_and_rf() {
        let frames = [
            frame([2.0, 0.001, 0.0], 0.0),
            frame([-0.001, 0.0, 0.001], 0.0),
            frame([2.01, 0.0, -0.001], 0.0),
            frame([-2.0, 0.0, 0.0], 0.0),
            frame([1.0, 0.0, 0.0], 0.0),
            frame([0.0, 0.0, 2.0], 0.0),
            frame([0.0, 0.0, 0.0], 2e-4),
        ];
        let settings = Settings::of(&frames, &[0; 7], 2e-4);
        assert_eq!(settings.of_frame, [0, 1, 0, 2, 3, 4, 5].map(Some));
        assert_eq!(settings.count, 6);
        assert_eq!(settings.corrector, [Some(0), None, Some(0), Some(0), Some(0), Some(2), None]);
        let at_two_times = Settings::of(&frames, &[0, 0, 1, 0, 0, 0, 0], 2e-4);
        assert_eq!(at_two_times.of_frame, [0, 1, 2, 3, 4, 5, 6].map(Some));
    }

    #[test]
    fn several_correctors_at_once_are_a_setting_only_where_they_are_repeated() {
        let (bump, feedback) = (frame([1.0, -2.0, 1.0], 0.0), frame([1.5, 1.0, 0.0], 0.0));
        let settings = Settings::of(&[bump.clone(), feedback, bump, frame([0.0, 1.0, 0.0], 0.0)], &[0; 4], 2e-4);
        assert_eq!(settings.of_frame, [Some(0), None, Some(0), Some(2)]);
    }
}
