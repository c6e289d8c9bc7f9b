//! Readings as they differ within the runs of frames of one setting.
//!
//! In a run the machine is the same, so that a reading less the mean of its run is noise, or passes. The momentum's jitter moves all
//! monitors of a frame along the dispersion, and the orbit of misaligned quadrupoles follows the ripple of the supplies; as nothing is known of their
//! sizes here, that direction of each frame, and what each monitor has in common with each supply, are left out.

use core::ops::Range;

use inference::{Excluded, Exclusions};
use nalgebra::{DMatrix, DVector, DVectorView};

/// The operator that takes readings, or a signal in them, to numbers of variance 1.
#[derive(Debug, Clone)]
pub struct Differences {
    /// Frames of each run, two or more.
    pub runs: Vec<Range<usize>>,
    excluded: Exclusions,
    /// Noise of each monitor [m].
    sigma: Vec<f64>,
    /// Dispersion of each monitor over its noise [1].
    dispersion: Vec<f64>,
    /// Of each monitor, what the supplies do within runs: orthonormal columns, rows frames.
    ripple: Vec<DMatrix<f64>>,
}

/// Fewest differences from which a monitor's noise is taken, and that of a normal number over its median size.
const FEWEST: usize = 20;
const NORMAL: f64 = 1.4826;
/// Distance from its run, in standard deviations, at which a reading jumps.
const JUMPS: f64 = 4.5;
/// Monitors that do not jump at once by themselves: the beam does.
const SEVERAL: usize = 3;
/// Median distance of all readings of a frame from their run, in standard deviations, at which there was no beam, or one from elsewhere: 0.7 is
/// usual.
const LOST: f64 = 4.0;

impl Differences {
    /// Of readings, rows frames, columns monitors, not a number where missing [m]; the setting of each frame; the noise that the header states [m]
    /// and the dispersion [m] of each monitor; `ln` of each supply's factor off its mean, rows frames.
    pub fn from_readings(
        readings: &DMatrix<f64>,
        settings: &[Option<usize>],
        noise: &[f64],
        dispersion: &DVector<f64>,
        fluctuation: &DMatrix<f64>,
    ) -> Self {
        let runs: Vec<Range<usize>> = runs(settings).into_iter().filter(|run| run.len() > 1).collect();
        // begun anew: what the screening takes for a jump may be what passes after a change
        let mut excluded = Exclusions::from_readings(readings);
        for frame in lost(readings, &runs, noise) {
            excluded.exclude_frame(frame, Excluded::LostBeam);
        }
        let mut sigma = noise.to_vec();
        let mut jumping = vec![Vec::new(); sigma.len()];
        for (b, sigma) in sigma.iter_mut().enumerate() {
            let reading = |frame: usize| if excluded.counts(frame, b) { readings[(frame, b)] } else { f64::NAN };
            let column: Vec<f64> = (0..readings.nrows()).map(reading).collect();
            let [typical, rms] = repeated(&column, &runs).unwrap_or([*sigma; 2]);
            if typical == 0.0 {
                excluded.exclude_monitor(b, Excluded::Stuck);
            } else {
                jumping[b] = jumps(&column, &runs, typical);
            }
            *sigma = rms;
        }
        // one that jumps by itself in later frames does so in first ones too, as if it were late
        let at_once = |frame: usize| jumping.iter().filter(|one| one.contains(&frame)).count();
        let by_itself = |frame: &usize| at_once(*frame) < SEVERAL;
        let jumps = jumping.iter().map(|one| one.iter().any(by_itself));
        for (b, _) in jumps.enumerate().filter(|(_, jumps)| *jumps) {
            excluded.exclude_monitor(b, Excluded::Jump);
        }
        let dispersion = dispersion.iter().zip(&sigma).map(|(d, sigma)| d / sigma.max(f64::MIN_POSITIVE)).collect();
        let mut differences = Self { runs, excluded, sigma, dispersion, ripple: Vec::new() };
        let of_supply = |column: DVectorView<f64>| {
            differences.within(&DMatrix::from_fn(readings.nrows(), readings.ncols(), |i, _| column[i]))
        };
        let of_supplies: Vec<DMatrix<f64>> = fluctuation.column_iter().map(of_supply).collect();
        let of_monitor = |b: usize| {
            let columns: Vec<_> = of_supplies.iter().map(|one| one.column(b)).collect();
            if columns.is_empty() {
                DMatrix::zeros(readings.nrows(), 0)
            } else {
                DMatrix::from_columns(&columns).qr().q()
            }
        };
        differences.ripple = (0..readings.ncols()).map(of_monitor).collect();
        differences
    }

    /// Less the mean of the run, over the noise, and without the ripple of the supplies and the direction of the dispersion; rows frames, columns
    /// monitors, 0 where nothing counts.
    pub fn whiten(&self, values: &DMatrix<f64>) -> DMatrix<f64> {
        let mut white = self.within(values);
        for (mut column, ripple) in white.column_iter_mut().zip(&self.ripple) {
            let common = ripple.tr_mul(&column);
            column.gemv(-1.0, ripple, &common, 1.0);
        }
        self.runs.iter().flat_map(Clone::clone).for_each(|frame| self.without_momentum(&mut white, frame));
        white
    }

    /// Less the mean of the run, over the noise; 0 where nothing counts.
    pub fn within(&self, values: &DMatrix<f64>) -> DMatrix<f64> {
        let mut white = DMatrix::zeros(values.nrows(), values.ncols());
        for run in &self.runs {
            for (b, sigma) in self.sigma.iter().enumerate() {
                let counting: Vec<usize> = run.clone().filter(|&frame| self.excluded.counts(frame, b)).collect();
                let mean = counting.iter().map(|&frame| values[(frame, b)]).sum::<f64>() / counting.len().max(1) as f64;
                counting.iter().for_each(|&frame| white[(frame, b)] = (values[(frame, b)] - mean) / sigma);
            }
        }
        white
    }

    fn without_momentum(&self, white: &mut DMatrix<f64>, frame: usize) {
        let counting: Vec<usize> = (0..white.ncols()).filter(|&b| self.excluded.counts(frame, b)).collect();
        let square: f64 = counting.iter().map(|&b| self.dispersion[b].powi(2)).sum();
        let along: f64 = counting.iter().map(|&b| self.dispersion[b] * white[(frame, b)]).sum();
        if square > 0.0 {
            counting.iter().for_each(|&b| white[(frame, b)] -= self.dispersion[b] * along / square);
        }
    }

    /// An orbit [m] that is added to every frame, over the noise and without the direction of the dispersion, rows frames; 0 where nothing counts.
    pub(crate) fn of_orbit(&self, orbit: &DVector<f64>) -> DMatrix<f64> {
        let mut all = self
            .excluded
            .counting()
            .map_with_location(|_, b, counts| if counts { orbit[b] / self.sigma[b] } else { 0.0 });
        self.runs.iter().flat_map(Clone::clone).for_each(|frame| self.without_momentum(&mut all, frame));
        all
    }

    /// Noise of a monitor [m].
    pub fn noise(&self, b: usize) -> f64 {
        self.sigma[b]
    }

    /// True for a reading that counts.
    pub fn counts(&self, frame: usize, b: usize) -> bool {
        self.excluded.counts(frame, b)
    }

    /// True for a monitor with readings that count.
    pub(crate) fn sees(&self, b: usize) -> bool {
        (0..self.excluded.size().0).any(|frame| self.excluded.counts(frame, b))
    }
}

/// Runs of consecutive frames of one setting; a frame of none is a run by itself.
pub fn runs(settings: &[Option<usize>]) -> Vec<Range<usize>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for (frame, setting) in settings.iter().enumerate() {
        match runs.last_mut() {
            Some(run) if setting.is_some() && settings[frame - 1] == *setting => run.end += 1,
            _ => runs.push(frame..frame + 1),
        }
    }
    runs
}

/// Mean of each frame's run, of numbers that are; rows frames.
pub fn run_means(values: &DMatrix<f64>, settings: &[Option<usize>]) -> DMatrix<f64> {
    let mut means = DMatrix::from_element(values.nrows(), values.ncols(), f64::NAN);
    for run in runs(settings) {
        for b in 0..values.ncols() {
            let known = || run.clone().map(|frame| values[(frame, b)]).filter(|x| x.is_finite());
            let mean = known().sum::<f64>() / known().count() as f64;
            run.clone().for_each(|frame| means[(frame, b)] = mean);
        }
    }
    means
}

/// Frames whose readings are far from the others of their run in another way than what passes: that is a share of the orbit of the run
/// before and of the run's own.
fn lost(readings: &DMatrix<f64>, runs: &[Range<usize>], noise: &[f64]) -> Vec<usize> {
    let middle = |b: usize, frames: &mut dyn Iterator<Item = usize>| {
        median(&mut frames.map(|frame| readings[(frame, b)]).filter(|x| x.is_finite()).collect::<Vec<_>>())
    };
    let monitors = readings.ncols();
    let orbit = |frames: &dyn Fn() -> Range<usize>, but: Option<usize>| {
        DVector::from_fn(monitors, |b, _| middle(b, &mut frames().filter(|frame| Some(*frame) != but)) / noise[b])
    };
    let baseline = orbit(&|| 0..readings.nrows(), None);
    let mut former = DVector::zeros(monitors);
    let mut found = Vec::new();
    for run in runs {
        for frame in run.clone() {
            let own = orbit(&|| run.clone(), Some(frame)) - &baseline;
            let read = DVector::from_fn(monitors, |b, _| readings[(frame, b)] / noise[b]) - &baseline;
            let known = read.map(f64::is_finite);
            let clean = |one: &DVector<f64>| one.zip_map(&known, |x, known| if known { x } else { 0.0 });
            let mut off = clean(&(read - &own));
            let directions = DMatrix::from_columns(&[clean(&own), clean(&former)]).qr().q();
            off -= &directions * directions.tr_mul(&off);
            let mut sizes: Vec<f64> =
                off.iter().zip(&known).filter(|(_, known)| **known).map(|(x, _)| x.abs()).collect();
            if median(&mut sizes) > LOST {
                found.push(frame);
            }
        }
        former = orbit(&|| run.clone(), None) - &baseline;
    }
    found
}

/// Noise of one reading by differences of neighbours, of which none is the first of its run [m], by their median size and by their rms, larger for
/// noise with tails: in the first something may pass.
fn repeated(column: &[f64], runs: &[Range<usize>]) -> Option<[f64; 2]> {
    let later = runs.iter().flat_map(|run| run.start + 2..run.end);
    let mut sizes: Vec<f64> =
        later.map(|frame| (column[frame] - column[frame - 1]).abs()).filter(|d| d.is_finite()).collect();
    let rms = (sizes.iter().map(|d| d * d).sum::<f64>() / sizes.len() as f64).sqrt();
    (sizes.len() >= FEWEST).then(|| [NORMAL * median(&mut sizes), rms].map(|d| d * core::f64::consts::FRAC_1_SQRT_2))
}

/// Frames after the first of their run that are far from the median of these.
fn jumps(column: &[f64], runs: &[Range<usize>], sigma: f64) -> Vec<usize> {
    let of_run = |run: &Range<usize>| {
        let later = (run.start + 1..run.end).filter(|&frame| column[frame].is_finite());
        let middle = median(&mut later.clone().map(|frame| column[frame]).collect::<Vec<_>>());
        later.filter(move |&frame| (column[frame] - middle).abs() > JUMPS * sigma)
    };
    runs.iter().flat_map(of_run).collect()
}

/// Median, 0 of none.
pub fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    if n == 0 { 0.0 } else { 0.5 * (values[n / 2] + values[(n - 1) / 2]) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_dispersion_and_the_means_of_runs_are_left_out_and_noise_becomes_one() {
        let settings: Vec<Option<usize>> = (0..90).map(|frame| Some(frame / 3 % 7)).collect();
        let noise = |frame: usize, b: usize| (12.9898 * (frame * 5 + b) as f64).sin() * 43758.5453 % 1.0;
        let dispersion = DVector::from_vec(vec![2.0, 1.0, -1.0, 0.0, 0.5]);
        let setting = |frame: usize, b: usize| (frame / 3 % 7 * (b + 1)) as f64;
        let readings = DMatrix::from_fn(90, 5, |frame, b| {
            setting(frame, b) + 0.1 * noise(frame, b) + dispersion[b] * 0.05 * (frame as f64).sin()
        });
        let differences =
            Differences::from_readings(&readings, &settings, &[0.1; 5], &dispersion, &DMatrix::zeros(90, 0));
        assert_eq!(differences.runs.len(), 30);
        let white = differences.whiten(&readings);
        let moved = differences.whiten(&DMatrix::from_fn(90, 5, |frame, b| setting(frame, b) + 7.0));
        assert!(moved.amax() < 1e-9, "a setting is the same in its run");
        let jitter = differences.whiten(&DMatrix::from_fn(90, 5, |frame, b| dispersion[b] * (frame as f64).cos()));
        assert!(jitter.amax() < 1e-9, "{jitter}");
        // two of three differences of a run, four of five directions: each has the variance 1, here by 240 numbers, within 30 %
        let variance = white.norm_squared() / (90.0 * 2.0 / 3.0 * 4.0);
        assert!((variance - 1.0).abs() < 0.3, "{variance}");
    }

    /// Frames of garbage do not count, first ones of their run or later; first ones that keep half of the former orbit do, and later ones
    /// of one monitor that is off by itself.
    #[test]
    fn frames_without_the_beam_do_not_count() {
        let orbit = |setting: usize, b: usize| 5.0 * (2.3 * (setting * 7 + b * b) as f64).sin();
        let readings = DMatrix::from_fn(120, 9, |frame, b| {
            let noise = 0.1 * (1.7 * (frame * frame + 31 * b) as f64).sin();
            let setting = frame / 6;
            let kept = if frame % 6 == 0 && frame > 0 { 0.5 } else { 0.0 };
            let lost = if [30, 57].contains(&frame) { 3.0 * (0.7 * (b * b + frame) as f64).cos() } else { 0.0 };
            (1.0 - kept) * orbit(setting, b) + kept * orbit(setting.saturating_sub(1), b) + noise + lost
        });
        let runs: Vec<Range<usize>> = (0..20).map(|run| 6 * run..6 * run + 6).collect();
        assert_eq!(lost(&readings, &runs, &[0.1; 9]), [30, 57]);
    }

    #[test]
    fn a_monitor_that_jumps_after_a_first_frame_does_not_count() {
        let settings: Vec<Option<usize>> = (0..120).map(|frame| Some(frame / 4)).collect();
        let mut readings = DMatrix::from_fn(120, 2, |frame, b| 0.1 * (1.7 * (frame * frame + b) as f64).sin());
        (readings[(10, 0)], readings[(8, 1)]) = (5.0, 5.0);
        let differences =
            Differences::from_readings(&readings, &settings, &[0.1; 2], &DVector::zeros(2), &DMatrix::zeros(120, 0));
        assert_eq!([0, 1].map(|b| differences.sees(b)), [false, true]);
        assert!(differences.whiten(&readings)[(8, 1)] > 10.0, "the first of a run is what is looked at");
    }

    /// Two monitors in one frame jump by themselves, three show the beam.
    #[test]
    fn monitors_that_jump_together_count() {
        let settings: Vec<Option<usize>> = (0..120).map(|frame| Some(frame / 4)).collect();
        for (jumping, count) in [(2, false), (3, true)] {
            let readings = DMatrix::from_fn(120, 8, |frame, b| {
                let jump = if frame == 10 && b < jumping { 1.0 } else { 0.0 };
                0.1 * (1.7 * (frame * frame + b) as f64).sin() + jump
            });
            let none = DMatrix::zeros(120, 0);
            let differences = Differences::from_readings(&readings, &settings, &[0.1; 8], &DVector::zeros(8), &none);
            assert!((0..8).all(|b| differences.sees(b) == (b >= jumping || count)), "{jumping}");
        }
    }
}
