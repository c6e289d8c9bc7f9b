//! The tune meter: one tune and its drift from all frames.

use nalgebra::{Matrix2, Vector2};

use crate::recording::{Recording, Row};

/// One measured tune: what it was in mid-campaign, and how much it changed to the end.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Meter {
    /// Fractional tune and its change [1].
    pub value: Vector2<f64>,
    /// Noise of one frame's tune [1].
    pub noise: f64,
    /// Standard deviation of the tune in mid-campaign, the calibration's included [1].
    pub sigma: f64,
    /// Whitens (value, change).
    pub whiten: Matrix2<f64>,
}

/// Calibration error of a tune meter [1], of the order of its resolution; all frames share it.
pub const TUNE_CALIBRATION: f64 = 3e-4;
/// Fewest readings: a line needs a few, and its noise some more.
const FEWEST: usize = 8;
/// Least noise of a reading: that of a number of five digits.
const ROUNDING: f64 = 3e-6;

impl Meter {
    /// Of the tune in x or y of a recording's frames without an RF offset, which moves it.
    pub fn from_recording(recording: &Recording, plane: usize) -> Option<Self> {
        let at_rest = |row: &Row| row.tune[plane].filter(|_| row.rf_offset == 0.0).unwrap_or(f64::NAN);
        let tunes: Vec<f64> = recording.rows.iter().map(at_rest).collect();
        Self::from_tunes(tunes.iter().zip(&recording.times()))
    }

    /// A line through the tunes over time, which goes from -1 to 1; missing ones are not numbers. None of too few.
    pub fn from_tunes<'a>(frames: impl Iterator<Item = (&'a f64, &'a f64)>) -> Option<Self> {
        let points: Vec<(f64, f64)> =
            frames.filter(|(tune, _)| !tune.is_nan()).map(|(tune, time)| (*time, *tune)).collect();
        if points.len() < FEWEST {
            return None;
        }
        let normal = points.iter().fold(Matrix2::zeros(), |sum, &(t, _)| sum + Matrix2::new(1.0, t, t, t * t));
        let moment = points.iter().fold(Vector2::zeros(), |sum, &(t, tune)| sum + Vector2::new(tune, t * tune));
        let value = normal.try_inverse()? * moment;
        // from one frame to the next, as the tune itself may move
        let squares: f64 = points.windows(2).map(|pair| (pair[1].1 - pair[0].1).powi(2)).sum();
        let variance = (0.5 * squares / (points.len() - 1) as f64).max(ROUNDING * ROUNDING);
        let covariance = normal.try_inverse()? * variance + Matrix2::new(TUNE_CALIBRATION.powi(2), 0.0, 0.0, 0.0);
        let whiten = covariance.cholesky()?.l().try_inverse()?;
        Some(Self { value, noise: variance.sqrt(), sigma: covariance[(0, 0)].sqrt(), whiten })
    }

    /// Whitened difference from a predicted tune and change; a tune is known up to an integer.
    pub fn miss(&self, predicted: Vector2<f64>) -> Vector2<f64> {
        let mut miss = self.value - predicted;
        miss[0] -= miss[0].round();
        self.whiten * miss
    }

    /// The tune with the integer part that is nearest to another.
    pub fn near(&self, tune: f64) -> f64 {
        self.value[0] + (tune - self.value[0]).round()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(tunes: &[f64]) -> Option<Meter> {
        let time: Vec<f64> = (0..tunes.len()).map(|i| 2.0 * i as f64 / (tunes.len() - 1) as f64 - 1.0).collect();
        Meter::from_tunes(tunes.iter().zip(&time))
    }

    #[test]
    fn it_knows_the_mean_and_the_drift_of_a_tune_but_no_integer() {
        let tunes: Vec<f64> =
            (0..100).map(|i| 0.8 + 2e-5 * f64::from(i) + if i % 2 == 0 { 5e-4 } else { -5e-4 }).collect();
        let meter = read(&tunes).unwrap();
        // neighbours differ by 1e-3, which is sqrt(2) of a noise of 7e-4
        assert!((meter.noise - 7.07e-4).abs() < 1e-5, "{meter:?}");
        assert!((meter.value[0] - 0.80099).abs() < 1e-9 && (meter.value[1] - 0.99e-3).abs() < 2e-5, "{meter:?}");
        assert!((meter.sigma - TUNE_CALIBRATION.hypot(7.07e-5)).abs() < 1e-7);
        assert!((meter.near(4.83) - 4.80099).abs() < 1e-9);
        // three integers off: nothing but rounding of a tune of 4, over a sigma of 3e-4
        assert!(meter.miss(meter.value + Vector2::new(3.0, 0.0)).norm() < 1e-9);
        assert!((meter.miss(Vector2::new(4.80099 + meter.sigma, meter.value[1]))[0] + 1.0).abs() < 1e-3);
    }

    #[test]
    fn few_readings_are_none_and_equal_ones_have_the_noise_of_rounding() {
        assert_eq!(read(&[0.8; 7]), None);
        assert_eq!(read(&[0.8; 8]).unwrap().noise, ROUNDING);
    }
}
