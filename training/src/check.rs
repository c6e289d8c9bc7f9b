//! Measured error of a surrogate against the exact twin.

use estimator::{Drive, Prediction, Surrogate};
use twin::{Hold, Optics, Ring};

use crate::green::BoosterGreen;

/// Error of one surrogate in one plane, on the -22 A to +22 A response over many vars.
#[derive(Debug, Clone, PartialEq)]
pub struct SurrogateError {
    /// Name of the surrogate.
    pub name: &'static str,
    /// `x` or `y`.
    pub plane: char,
    /// Numbers in the tables of both planes.
    pub parameters: usize,
    /// Bytes of the tables of both planes.
    pub bytes: usize,
    /// Vars within the tune cut that were tried.
    pub samples: usize,
    /// Rms over samples, monitors and correctors [m].
    pub rms: f64,
    /// Largest [m].
    pub max: f64,
    /// What the surrogate states of itself [m].
    pub stated_rms: f64,
}

/// Range of each var.
const RANGE: (f64, f64) = (0.94, 1.06);
/// Largest distance of a tune from the design that the paper's data allow.
pub const TUNE_CUT: f64 = 0.05;
/// Kick of -22 A to +22 A [rad].
const FULL_SWING: f64 = 0.4e-3;

/// Vars at point `i` of a scrambled Sobol sequence [N].
///
/// Source: B. Burley, Practical Hash-based Owen Scrambling, JCGT 9 (2020).
pub fn sobol_vars(i: u32, n: usize, seed: u32) -> Vec<f64> {
    let of = |d| RANGE.0 + (RANGE.1 - RANGE.0) * f64::from(sobol_burley::sample(i, d, seed));
    (0..n as u32).map(of).collect()
}

/// Measure the Green's function surrogate on `samples` vars within the tune cut; `progress` hears of each.
pub fn check(
    ring: &Ring,
    green: &BoosterGreen,
    samples: usize,
    seed: u32,
    mut progress: impl FnMut(),
) -> [SurrogateError; 2] {
    let design = Optics::of(ring, Hold::Momentum { delta: 0.0 }).expect("the surrogate has a design").tunes();
    let design = design.expect("the surrogate's design is stable");
    let (mut sums, mut largest, mut used) = ([0.0; 2], [0.0_f64; 2], 0);
    let mut linearised = <BoosterGreen as Surrogate<33, 48, 48>>::BLANK;
    for i in 0.. {
        if used == samples {
            break;
        }
        let vars = sobol_vars(i, 48, seed);
        let changed = ring.with_vars(&vars);
        let Ok(optics) = Optics::of(&changed, Hold::Momentum { delta: 0.0 }) else { continue };
        let Ok(tunes) = optics.tunes() else { continue };
        if (tunes.x - design.x).abs() > TUNE_CUT || (tunes.y - design.y).abs() > TUNE_CUT {
            continue;
        }
        let exact = optics.response(&optics.read_monitors(), &optics.correctors());
        let strength: [f32; 48] = core::array::from_fn(|q| vars[q] as f32);
        let solved = Surrogate::<33, 48, 48>::linearise(green, &strength, &mut linearised);
        solved.expect("a ring within the tune cut is connected with the design");
        let mut prediction = Prediction::<33, 48>::BLANK;
        for c in 0..48 {
            let mut drive = Drive { kick: [0.0; 48], strength: [0.0; 2], rf_offset: 0.0 };
            drive.kick[c] = FULL_SWING as f32;
            green.predict(&linearised, &drive, &mut prediction);
            let plane = usize::from(c >= 24);
            for b in if plane == 0 { 0..15 } else { 15..33 } {
                let error = (f64::from(prediction.reading[b]) - FULL_SWING * exact[(b, c)]).abs();
                sums[plane] += error * error;
                largest[plane] = largest[plane].max(error);
            }
        }
        used += 1;
        progress();
    }
    [0, 1].map(|plane| SurrogateError {
        name: "green",
        plane: ['x', 'y'][plane],
        parameters: BoosterGreen::PARAMETERS,
        bytes: BoosterGreen::BYTES,
        samples: used,
        rms: (sums[plane] / (used * 24 * [15, 18][plane]) as f64).sqrt(),
        max: largest[plane],
        stated_rms: f64::from(green.stated_error[plane]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_green_surrogate_is_as_good_as_it_states() {
        let ring = Ring::booster();
        let green = crate::green::tables(&ring).unwrap();
        for plane in check(&ring, &green, 100, 1, || ()) {
            assert!(plane.rms < plane.stated_rms, "{plane:?}");
            assert!(plane.rms > 0.1 * plane.stated_rms, "stated too generously: {plane:?}");
        }
        const { assert!(BoosterGreen::BYTES <= 64 * 1024) };
    }
}
