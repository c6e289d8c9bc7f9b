//! Beta and tunes of fitted matrices of a 1.37 GeV ring against runs that changed one quadrupole after the other and read both tunes.
//!
//! The run sets a magnet half a step below and above its gradient. The fitted ring is asked for the same: its tunes at both gradients, coupled as it
//! is and along the whole magnet. The magnets follow less than they are set to, by a share that all of one day have in common.

use measured::{Diagnosis, FittedRing, Folder, Settings, Straightened};
use nalgebra::DVector;
use serde_json::Value;
use system_tests::measured_ring;
use twin::{Hold, Kind, Optics, OrbitError, Ring};

/// A magnet's middle [m], the step of its gradient [1/m^2], and both tunes below and above.
struct Step {
    s: f64,
    gradient: f64,
    tunes: [[f64; 2]; 2],
}

/// Quadrupoles are so long [m]; their halves lie beside their middles.
const LENGTH: f64 = 0.27;
/// A reading counts where the mean of both tunes is so near to the median of seven neighbours: the largest step of a good one moves it by 0.002.
const LOST: f64 = 0.004;

impl Step {
    fn change(&self, plane: usize) -> f64 {
        self.tunes[1][plane] - self.tunes[0][plane]
    }

    fn mean(&self, plane: usize) -> f64 {
        0.5 * (self.tunes[1][plane] + self.tunes[0][plane])
    }

    /// True where a stronger gradient moved the tunes the wrong way, as no beta function does.
    fn is_wrong(&self, plane: usize) -> bool {
        let sign = [1.0, -1.0][plane];
        sign * self.change(plane) * self.gradient < 0.0
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Steps of a day, in the order they were made.
fn steps(day: &str) -> Option<Vec<Step>> {
    let text = std::fs::read_to_string(measured_ring("uvx/quad-shunt")?.join(format!("beta_{day}.json"))).unwrap();
    let file: Value = serde_json::from_str(&text).unwrap();
    let pair = |value: &Value| [0, 1].map(|plane| value[plane].as_f64().unwrap());
    let step = |one: &Value| Step {
        s: one["s_m"].as_f64().unwrap(),
        gradient: one["K1"].as_f64().unwrap() - one["K0"].as_f64().unwrap(),
        tunes: [pair(&one["tunes0"]), pair(&one["tunes1"])],
    };
    Some(file["quads"].as_array().unwrap().iter().map(step).collect())
}

/// Which steps have both tunes read.
fn read(steps: &[Step]) -> Vec<bool> {
    let is_near = |i: usize, plane: usize| {
        let near = &steps[i.saturating_sub(3)..steps.len().min(i + 4)];
        (steps[i].mean(plane) - median(near.iter().map(|one| one.mean(plane)).collect())).abs() < LOST
    };
    (0..steps.len()).map(|i| is_near(i, 0) && is_near(i, 1)).collect()
}

/// Noise of a change of tune, from second differences of the means, which have 1.5 times its variance: no beta function is in it.
fn noise(steps: &[Step], plane: usize) -> f64 {
    let bend = |three: &[Step]| (three[0].mean(plane) - 2.0 * three[1].mean(plane) + three[2].mean(plane)).abs();
    median(steps.windows(3).map(bend).collect()) / 0.674 / 1.5_f64.sqrt()
}

fn tunes(ring: &Ring) -> Result<[f64; 2], OrbitError> {
    let tunes = Optics::of(ring, Hold::Momentum { delta: 0.0 })?.tunes()?;
    Ok([tunes.x, tunes.y])
}

/// What the run would find on a ring: the changes of both tunes step by step, then the tunes.
fn run(ring: &Ring, steps: &[Step]) -> Result<DVector<f64>, OrbitError> {
    let set = |one: &Step, share: f64| {
        let mut ring = ring.clone();
        for element in &mut ring.elements {
            let is_half = (element.s + 0.5 * element.length - one.s).abs() < 0.5 * LENGTH;
            if let (true, Kind::Quadrupole { k1 }) = (is_half, &mut element.kind) {
                *k1 += share * one.gradient;
            }
        }
        tunes(&ring)
    };
    let mut found = Vec::new();
    for one in steps {
        let (below, above) = (set(one, -0.5)?, set(one, 0.5)?);
        found.extend([0, 1].map(|plane| above[plane] - below[plane]));
    }
    found.extend(tunes(ring)?);
    Ok(DVector::from_vec(found))
}

/// Common scale of the measured changes over those of a ring, and the mean square of what is left over its error.
fn compared(steps: &[Step], found: &DVector<f64>, sigma: &DVector<f64>) -> (f64, f64) {
    let noise = [0, 1].map(|plane| noise(steps, plane));
    let counted: Vec<(usize, usize)> =
        (0..steps.len()).zip(read(steps)).filter(|(_, is_read)| *is_read).flat_map(|(i, _)| [(i, 0), (i, 1)]).collect();
    let sum = |of: &dyn Fn(f64, f64, f64) -> f64, scale: f64| -> f64 {
        let term = |&(i, plane): &(usize, usize)| {
            let variance = noise[plane].powi(2) + (scale * sigma[2 * i + plane]).powi(2);
            of(steps[i].change(plane), found[2 * i + plane], variance)
        };
        counted.iter().map(term).sum()
    };
    let better = |scale, _| {
        sum(&|seen, found, variance| seen * found / variance, scale)
            / sum(&|_, found, variance| found * found / variance, scale)
    };
    let scale = (0..5).fold(1.0, better);
    let squares = sum(&|seen, found, variance| (seen - scale * found).powi(2) / variance, scale);
    (scale, squares / counted.len() as f64)
}

/// The lattice has insertion devices as drifts. What those that were closed on 22 June focus vertically, a fit as LOCO's gives to quadrupoles, and its
/// vertical tune is 0.006 off; the fit of a diagnosis has straights that focus.
#[test]
fn fitted_beta_is_that_of_changed_quadrupoles() {
    println!("day, program, scale, mean square pull, of the lattice as written, tunes less measured ones, their sigma");
    let mut used = Vec::new();
    for (day, folder) in [
        ("2012-08-25_07-10-40", "families_3/before"),
        ("2013-06-22_14-55-17", "families_2/before"),
        ("2013-06-22_16-44-46", "families_2/after"),
    ] {
        let (Some(steps), Some(path)) = (steps(day), measured_ring(&format!("uvx/{folder}"))) else { return };
        let wrong = steps.iter().flat_map(|one| [one.is_wrong(0), one.is_wrong(1)]).filter(|wrong| *wrong).count();
        if wrong > steps.len() / 10 {
            println!("{day}: {wrong} of {} tunes moved the wrong way, no measurement of beta", 2 * steps.len());
            continue;
        }
        let settings = Settings::default();
        let straightened = Straightened::of(&Folder::read(&path).unwrap(), &settings, &mut |_| ()).unwrap();
        let Straightened { folder, cables, fit } = &straightened;
        let diagnosis = Diagnosis::of_fit((folder, cables), fit, &settings, &mut |_| ()).unwrap();
        let written = run(&measured::lattice::ring(folder, &[], &[]).unwrap(), &steps).unwrap();
        let (_, pull_written) = compared(&steps, &written, &DVector::zeros(written.len()));
        let first = [0, 1].map(|plane| median(steps[1..4].iter().map(|one| one.mean(plane)).collect()));
        for (name, fitted) in [
            ("fit", FittedRing::of(folder, fit, &settings).unwrap()),
            ("diagnose", FittedRing::of(folder, &diagnosis.hierarchy, &settings).unwrap()),
        ] {
            let [found, sigma] = fitted.functions(|ring| run(ring, &steps)).unwrap();
            let (scale, pull) = compared(&steps, &found, &sigma);
            let [off, error] = [0, 1].map(|which| {
                [0, 1].map(|plane| {
                    let at = 2 * steps.len() + plane;
                    if which == 0 { found[at].fract() - first[plane] } else { sigma[at] }
                })
            });
            println!("{day}, {name}, {scale:.3}, {pull:.2}, {pull_written:.2}, {off:+.4?}, {error:.4?}");
            assert!(pull < 1.5 && pull < pull_written, "{day}: {pull}, as written {pull_written}");
            // steps of iron that is not cycled are some 10 % smaller than set
            assert!((0.8..1.0).contains(&scale), "{day}: {scale}");
            assert!(off[0].abs() < 0.002, "{day}: {off:?}");
            // the fit has no insertion devices, which were closed in 2013
            let is_complete = name == "diagnose" || day.starts_with("2012");
            // one reading is good to 0.0007, and both days are 0.0014 to 0.0020 below it
            assert!(!is_complete || off[1].abs() < 0.0025, "{day}: {off:?}");
        }
        used.push(day);
    }
    assert_eq!(used.len(), 2, "{used:?}");
}
