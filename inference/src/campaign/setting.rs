//! The settings of a campaign: frames with the same kicks, RF offset and time in the cycle, by their read-backs.
//!
//! Whatever groups frames takes its groups from here: the screening and the fit those of frames, the diagnosis those of the means of runs.

use estimator::{SAME_KICK, SAME_OFFSET};
use nalgebra::{DMatrix, DVector};
use twin::Drives;

use super::idle::Idle;
use crate::recording::Drive;

/// Frames grouped by setting.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Setting of each frame.
    pub of_frame: Vec<usize>,
    /// The same; none of a frame in which several things were moved and that no other repeats.
    pub repeatable: Vec<Option<usize>>,
    /// Where correctors stand idle.
    pub idle: Idle,
    settings: Vec<Setting>,
    /// Largest kick that a corrector was set to [rad].
    pub nominal_kick: f64,
}

/// What is moved in a frame: correctors, each by its kick off where it stands idle, and the RF; and which of the times in the cycle it has.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    time: usize,
    kicks: Vec<(usize, f64)>,
    rf_offset: f64,
}

/// True if two RF offsets are those of one setting.
fn is_same_offset(first: f64, second: f64) -> bool {
    // the core counts in steps of 1e-9
    (first - second).abs() <= f64::from(SAME_OFFSET) / 1e9
}

/// True if two kicks of one corrector are those of one setting; `scatter`: what its scatter makes of one kick.
fn is_same_kick(first: f64, second: f64, scatter: f64) -> bool {
    (first - second).abs() <= (first.abs().max(second.abs()) / f64::from(SAME_KICK)).max(scatter)
}

/// Number of frames with each frame's RF offset.
pub(super) fn sharing(drives: &[Drive]) -> Vec<f64> {
    let is_alike = |drive: &Drive, other: &&Drive| is_same_offset(other.rf_offset, drive.rf_offset);
    drives.iter().map(|drive| drives.iter().filter(|other| is_alike(drive, other)).count() as f64).collect()
}

impl Settings {
    /// Group the frames of a campaign, each with its time in the cycle; `nominal_kick`: the largest that a corrector was set to [rad].
    pub fn from_frames(drives: &[Drive], times: &[usize], nominal_kick: f64) -> Self {
        let kick: Vec<_> = drives.iter().map(|drive| drive.kick.transpose()).collect();
        let rf_offset: Vec<f64> = drives.iter().map(|drive| drive.rf_offset).collect();
        Self::group(&DMatrix::from_rows(&kick), &rf_offset, times, nominal_kick)
    }

    /// Group drives at one time in the cycle: of frames, or of means of frames.
    pub fn from_drives(drives: &Drives) -> Self {
        let times = vec![0; drives.kick.nrows()];
        Self::group(&drives.kick, drives.rf_offset.as_slice(), &times, drives.nominal_kick)
    }

    fn group(kick: &DMatrix<f64>, rf_offset: &[f64], times: &[usize], nominal_kick: f64) -> Self {
        let idle = Idle::from_kicks(kick, nominal_kick);
        let (mut settings, mut repeats): (Vec<Setting>, Vec<usize>) = (Vec::new(), Vec::new());
        let index = |frame: usize| {
            let moved = Setting::new(&idle, kick.row(frame).iter(), rf_offset[frame], times[frame]);
            let known = settings.iter().position(|known| known.is_repeated_by(&moved, &idle));
            let index = known.unwrap_or_else(|| {
                settings.push(moved);
                repeats.push(0);
                settings.len() - 1
            });
            repeats[index] += 1;
            index
        };
        let of_frame: Vec<usize> = (0..times.len()).map(index).collect();
        let is_repeatable = |setting: &usize| repeats[*setting] > 1 || settings[*setting].things() <= 1;
        let repeatable = of_frame.iter().map(|setting| Some(*setting).filter(is_repeatable)).collect();
        Self { repeatable, of_frame, idle, settings, nominal_kick }
    }

    /// True if a corrector is moved in any setting.
    pub fn moves(&self, corrector: usize) -> bool {
        self.settings.iter().any(|setting| setting.moves(corrector))
    }

    /// Number of settings.
    pub fn count(&self) -> usize {
        self.settings.len()
    }

    /// The setting of a frame.
    pub fn setting(&self, frame: usize) -> &Setting {
        &self.settings[self.of_frame[frame]]
    }

    /// The corrector that is moved most in a frame, and the sign of its kick.
    pub fn kick(&self, frame: usize) -> Option<(usize, f64)> {
        let strongest =
            self.setting(frame).kicks.iter().max_by(|(_, one), (_, other)| one.abs().total_cmp(&other.abs()));
        strongest.map(|(corrector, kick)| (*corrector, kick.signum()))
    }

    /// Rows frames, columns settings.
    pub fn indicator(&self) -> DMatrix<f64> {
        let mut indicator = DMatrix::zeros(self.of_frame.len(), self.count());
        self.of_frame.iter().enumerate().for_each(|(frame, &setting)| indicator[(frame, setting)] = 1.0);
        indicator
    }

    /// Settings in which a corrector is moved.
    pub fn with_corrector(&self, corrector: usize) -> Vec<usize> {
        (0..self.count()).filter(|&i| self.settings[i].moves(corrector)).collect()
    }

    /// By how much a corrector is moved in each setting, in units of the nominal kick.
    pub fn strength_of(&self, corrector: usize) -> DVector<f64> {
        let kick = |setting: &Setting| setting.kick_of(corrector).map_or(0.0, |kick| kick / self.nominal_kick);
        DVector::from_iterator(self.count(), self.settings.iter().map(kick))
    }

    /// Mean drive of each setting, on the reference orbit, in mid-campaign; `drives`: those that were grouped.
    pub fn means(&self, drives: &Drives) -> Drives {
        let indicator = self.indicator();
        let count = indicator.row_sum();
        let mut kick = indicator.transpose() * &drives.kick;
        kick.row_iter_mut().zip(count.iter()).for_each(|(mut row, count)| row /= *count);
        let rf_offset = (indicator.transpose() * &drives.rf_offset).component_div(&count.transpose());
        let orbit = vec![[0.0; 2]; drives.orbit.len()];
        Drives { kick, rf_offset, time: DVector::zeros(self.count()), nominal_kick: drives.nominal_kick, orbit }
    }
}

impl Setting {
    fn new<'k>(idle: &Idle, kicks: impl Iterator<Item = &'k f64>, rf_offset: f64, time: usize) -> Self {
        let moved = kicks.enumerate().filter_map(|(c, kick)| Some((c, idle.moved(c, *kick)?)));
        Self { time, kicks: moved.collect(), rf_offset }
    }

    /// How many things are moved.
    fn things(&self) -> usize {
        self.kicks.len() + usize::from(!is_same_offset(self.rf_offset, 0.0))
    }

    /// The corrector that alone is moved.
    pub fn only_corrector(&self) -> Option<usize> {
        (self.things() == 1).then(|| self.kicks.first().map(|(corrector, _)| *corrector)).flatten()
    }

    /// True if a corrector is moved.
    pub fn moves(&self, corrector: usize) -> bool {
        self.kick_of(corrector).is_some()
    }

    /// By how much a corrector is moved [rad].
    fn kick_of(&self, corrector: usize) -> Option<f64> {
        self.kicks.iter().find(|(powered, _)| *powered == corrector).map(|(_, kick)| *kick)
    }

    fn is_repeated_by(&self, other: &Self, idle: &Idle) -> bool {
        let same = |((corrector, kick), (another, again)): (&(usize, f64), &(usize, f64))| {
            corrector == another && is_same_kick(*kick, *again, idle.scatter[*corrector])
        };
        self.time == other.time
            && self.kicks.len() == other.kicks.len()
            && self.kicks.iter().zip(&other.kicks).all(same)
            && is_same_offset(self.rf_offset, other.rf_offset)
    }
}

#[cfg(test)]
mod tests {
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
        let settings = Settings::from_frames(&frames, &[0; 7], 2e-4);
        assert_eq!(settings.of_frame, [0, 1, 0, 2, 3, 4, 5]);
        assert_eq!(settings.count(), 6);
        let correctors: Vec<_> = (0..7).map(|frame| settings.setting(frame).only_corrector()).collect();
        assert_eq!(correctors, [Some(0), None, Some(0), Some(0), Some(0), Some(2), None]);
        let at_two_times = Settings::from_frames(&frames, &[0, 0, 1, 0, 0, 0, 0], 2e-4);
        assert_eq!(at_two_times.of_frame, [0, 1, 2, 3, 4, 5, 6]);
    }

    #[test]
    fn several_correctors_at_once_are_a_setting_only_where_they_are_repeated() {
        let (bump, feedback) = (frame([1.0, -2.0, 1.0], 0.0), frame([1.5, 1.0, 0.0], 0.0));
        let settings =
            Settings::from_frames(&[bump.clone(), feedback, bump, frame([0.0, 1.0, 0.0], 0.0)], &[0; 4], 2e-4);
        assert_eq!(settings.of_frame, [0, 1, 0, 2]);
        assert_eq!(settings.repeatable, [Some(0), None, Some(0), Some(2)]);
    }

    /// A feedback on two correctors and the RF, and one that is idle but for its scatter.
    #[test]
    fn a_setting_has_the_kicks_that_are_powered() {
        let settings =
            Settings::from_frames(&[frame([1.0, -2.0, 0.09], 0.0), frame([0.0, 0.0, 0.0], 2e-4)], &[0; 2], 2e-4);
        assert_eq!((settings.kick(0), settings.kick(1)), (Some((1, -1.0)), None));
        assert_eq!(settings.with_corrector(0), [0]);
        assert_eq!(settings.strength_of(1).as_slice(), [-1.0, 0.0]);
    }

    #[test]
    fn a_setting_of_means_has_their_mean_drive() {
        let kick = DMatrix::from_row_slice(3, 2, &[2.0, 0.01, 0.0, 2.0, 2.04, -0.01]) * 1e-4;
        let rf_offset = DVector::from_vec(vec![0.0, 3e-7, 0.0]);
        let time = DVector::from_vec(vec![-1.0, 0.0, 1.0]);
        let drives = Drives { kick, rf_offset, time, nominal_kick: 2e-4, orbit: vec![[1e-3; 2]; 2] };
        let settings = Settings::from_drives(&drives);
        assert_eq!(settings.of_frame, [0, 1, 0]);
        assert_eq!(settings.indicator(), DMatrix::from_row_slice(3, 2, &[1.0, 0.0, 0.0, 1.0, 1.0, 0.0]));
        let means = settings.means(&drives);
        assert!((means.kick - DMatrix::from_row_slice(2, 2, &[2.02e-4, 0.0, 0.0, 2e-4])).amax() < 1e-18);
        assert_eq!((means.rf_offset.as_slice(), means.orbit), ([0.0, 3e-7].as_slice(), vec![[0.0; 2]; 2]));
    }
}
