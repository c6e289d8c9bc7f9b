//! Several frames a cycle along a ramp: exact closed orbits of a machine whose energy, magnets and remanent fields are written down
//! here, through the files, the core and the batch fit.

use std::path::{Path, PathBuf};

use inference::simulate::{self, Hardware};
use inference::stream::{self, Walk};
use inference::{BatchFit, Campaign, Recording, TuneUse};
use nalgebra::{DMatrix, DVector};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand_distr::{Distribution, StandardNormal};
use serde_json::{Value, json};
use twin::{Cycle, Machine, Rf, Ring, Tracked};

/// Rest energy of a proton [GeV].
const PROTON: f64 = 0.938_272_088_16;
/// Times in the cycle [ms], kinetic energies there [GeV], and by how much the supplies QH and QV then are off their nominal currents:
/// they follow the ramp to one part in a thousand.
const TIMES: [(f64, f64, [f64; 2]); 4] = [
    (50.0, 0.35, [1.5e-3, -1.0e-3]),
    (70.0, 0.65, [0.5e-3, 1.0e-3]),
    (90.0, 1.05, [-1.0e-3, 0.5e-3]),
    (110.0, 1.5, [0.0, 0.0]),
];
/// Kinetic energy at which the machine file has its strengths [GeV].
const REFERENCE: f64 = 1.5;
/// Scatter of the supplies and of the dipoles from frame to frame.
const RIPPLE: f64 = 2e-4;

/// A file or folder of the repository.
fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Momentum of a proton [GeV/c].
fn momentum(kinetic_energy: f64) -> f64 {
    (kinetic_energy * (kinetic_energy + 2.0 * PROTON)).sqrt()
}

/// Gradient of a quadrupole over that at its nominal current: remanence, a linear part, saturation.
fn gradient(over_nominal: f64) -> f64 {
    let coefficients = [0.0016, 1.0121, -0.0021, -0.0052, -0.0049, -0.0015];
    let of = |r: f64| coefficients.iter().rev().fold(0.0, |sum, c| sum * r + c);
    of(over_nominal) / of(1.0)
}

/// Field of the dipoles over that at 2400 A: they saturate by 2 %.
fn field(over_nominal: f64) -> f64 {
    over_nominal * (1.0 - 0.02 * over_nominal.powi(4)) / 0.98
}

/// The current at which something that grows with it has a value, over the nominal one.
fn current_for(value: f64, of: impl Fn(f64) -> f64) -> f64 {
    let (mut low, mut high) = (0.0, 1.5);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        (low, high) = if of(middle) < value { (middle, high) } else { (low, middle) };
    }
    low
}

/// Nominal currents of dipoles and both supplies at a kinetic energy [A].
fn currents(kinetic_energy: f64) -> [f64; 3] {
    let over_reference = momentum(kinetic_energy) / momentum(REFERENCE);
    let (dipole, quadrupole) = (current_for(over_reference, field), current_for(over_reference, gradient));
    [2400.0 * dipole, 1800.0 * quadrupole, 1790.0 * quadrupole]
}

/// The Booster with a ramp of these times.
fn ramped(times: &[(f64, f64)]) -> Ring {
    let mut file: Value =
        serde_json::from_str(&std::fs::read_to_string(repository("machines/booster.json")).unwrap()).unwrap();
    let point = |&(time, energy): &(f64, f64)| {
        let [dipole, qh, qv] = currents(energy);
        let supplies = json!({"QH": qh, "QV": qv});
        json!({"t_cycle_ms": time, "kinetic_energy_GeV": energy, "dipole_A": dipole, "supply_A": supplies})
    };
    file["ramp"] = times.iter().map(point).collect();
    Ring::parse(&file.to_string(), "booster.json").unwrap()
}

/// The Booster with a ramp of the times at which frames are read.
fn with_ramp() -> Ring {
    ramped(&TIMES.map(|(time, energy, _)| (time, energy)))
}

/// What a campaign is made with.
struct Truth {
    vars: Vec<f64>,
    /// Kicks of remanent fields at the correctors, at the reference momentum [rad]: those that make the orbit at 50 ms differ from that
    /// at 110 ms by `apart` [m rms].
    apart: f64,
    seed: u64,
}

/// A campaign of `paper-vars` with every cycle read at all times, by the exact twin.
fn campaign(truth: &Truth) -> Recording {
    let design = Ring::booster();
    let template = Recording::read(&repository("recordings/paper-vars"), &design).unwrap();
    let mut streams = simulate::seeds(truth.seed).map(StdRng::seed_from_u64);
    let [mut machine, mut ripple, mut noise] = core::array::from_fn(|_| streams.next().unwrap());
    let normal = |random: &mut StdRng| -> f64 { StandardNormal.sample(random) };
    let mut ring = template.powered(&design).with_vars(&truth.vars);
    let hardware = Hardware::shipped(&ring, &template);
    for quadrupole in &ring.quadrupoles {
        let misalignment = &mut ring.elements[quadrupole.element].misalignment;
        (misalignment.dx, misalignment.dy) =
            (hardware.misalignment[0] * normal(&mut machine), hardware.misalignment[1] * normal(&mut machine));
    }
    let e = |name: &str, d: f64| std::env::var(name).map_or(d, |v| v.parse().unwrap());
    for quadrupole in &ring.quadrupoles {
        let m = &mut ring.elements[quadrupole.element].misalignment;
        (m.dx, m.dy) = (m.dx * e("MIS", 1.0), m.dy * e("MIS", 1.0));
    }
    let offsets: Vec<f64> = hardware.noise.iter().map(|_| hardware.offset * normal(&mut machine)).collect();
    let remanent: Vec<f64> = ring.correctors.iter().map(|_| normal(&mut machine)).collect();
    let at_energy = |energy: f64| {
        let mut ring = ring.clone();
        ring.particle.kinetic_energy = energy;
        Tracked::of(Machine::new(ring, Rf::FixedMomentum, &[]).unwrap(), 2e-4).unwrap()
    };
    let tracked = TIMES.map(|(_, energy, _)| at_energy(energy));
    let focuses: Vec<bool> = ring.gradients().iter().map(|k1| *k1 > 0.0).collect();
    let cycle = |kick: Vec<f64>, supplies: [f64; 2], rf_offset: f64| {
        let strength = focuses.iter().map(|focuses| supplies[usize::from(!focuses)]).collect();
        Cycle { kick, strength, rf_offset, time: 0.0 }
    };
    // kicks that are the same at all momenta differ by what they make over that
    let over_reference = |energy: f64| momentum(energy) / momentum(REFERENCE);
    let lowest = over_reference(TIMES[0].1).recip() - 1.0;
    let still = tracked[3].cycle(&cycle(vec![0.0; remanent.len()], [0.0; 2], 0.0)).unwrap().0;
    let small: Vec<f64> = remanent.iter().map(|kick| 1e-6 * kick).collect();
    let moved = tracked[3].cycle(&cycle(small, [0.0; 2], 0.0)).unwrap().0;
    let squares: f64 = still.iter().zip(&moved).map(|(one, other)| (one - other).powi(2)).sum();
    let size = 1e-6 * truth.apart / (lowest * (squares / still.len() as f64).sqrt());
    let mut recording = template.clone();
    recording.name = "ramp".into();
    recording.rows.clear();
    for (at_cycle, given) in template.rows.iter().enumerate() {
        for (k, (time, energy, off)) in TIMES.into_iter().enumerate() {
            let mut row = given.clone();
            let p = over_reference(energy);
            let [dipole, qh, qv] = currents(energy);
            let dipoles = 1.0 + e("RIP", 1.0) * RIPPLE * normal(&mut ripple);
            let x: f64 = std::env::var("OFF").map_or(1.0, |v| v.parse().unwrap());
            let scale: bool = std::env::var("SCALE").is_ok();
            if scale {
                row.corrector_current.iter_mut().for_each(|c| *c *= p);
                row.correctors.iter_mut().for_each(|c| c.1 *= p);
            }
            let supplies = [0, 1].map(|f| (1.0 + x * off[f]) * (1.0 + e("RIP", 1.0) * RIPPLE * normal(&mut ripple)));
            (row.sequence, row.time, row.cycle_time) = ((4 * at_cycle + k) as u32, given.time + time / 1e3, time / 1e3);
            (row.dipole, row.supply) = (Some(dipole * dipoles), vec![qh * supplies[0], qv * supplies[1]]);
            // at the dipoles' own read-back; 22 A kick by 0.2 mrad at the reference momentum
            let stiffness = p * dipoles;
            let kick = |(current, remanent): (&f64, &f64)| (2e-4 / 22.0 * current + size * remanent) / stiffness;
            let kicks = row.corrector_current.iter().zip(&remanent).map(kick).collect();
            let strength = [0, 1].map(|f| (gradient(row.supply[f] / [1800.0, 1790.0][f]) / stiffness).ln());
            let (orbit, tunes) = tracked[k].cycle(&cycle(kicks, strength, row.rf_offset)).unwrap();
            for (b, reading) in row.reading.iter_mut().enumerate() {
                let read = orbit[b] + offsets[b] + hardware.noise[b] * normal(&mut noise);
                *reading = reading.map(|_| read);
            }
            if std::env::var("ONLY").is_ok_and(|v| v.parse::<usize>().unwrap() != k) {
                continue;
            }
            row.tune = [tunes.x, tunes.y]
                .map(|tune| Some((tune + 5e-4 * normal(&mut noise)).rem_euclid(1.0)))
                .map(|t| t.filter(|_| e("TUNE", 1.0) > 0.0));
            if e("RF", 1.0) == 0.0 && row.rf_offset != 0.0 {
                continue;
            }
            recording.rows.push(row);
        }
    }
    recording
}

/// A recording written for a ring and read again.
fn through_files(recording: &Recording, ring: &Ring) -> Result<Recording, String> {
    let home = tempfile::tempdir().unwrap();
    let folder = home.path().join("ramp");
    recording.write(&folder, ring).unwrap();
    let strip =
        |error: inference::RecordingError| error.to_string().replace(&format!("{}/", home.path().display()), "");
    Recording::read(&folder, ring).map_err(strip)
}

/// NEES over the number of params.
fn nees(params: &[f64], covariance: &DMatrix<f64>, vars: &[f64]) -> f64 {
    let miss = DVector::from_iterator(vars.len(), params.iter().zip(vars).map(|(theta, var)| theta - var.ln()));
    let factor = covariance.clone().cholesky().expect("a covariance is positive");
    miss.dot(&factor.solve(&miss)) / vars.len() as f64
}

/// What core and batch make of a recording.
struct Fitted {
    core: Vec<f64>,
    core_covariance: DMatrix<f64>,
    chi2: f64,
    batch: BatchFit,
}

fn fitted(ring: &Ring, recording: &Recording) -> Fitted {
    let mut core = stream::estimator(ring, recording, Walk::NONE).unwrap();
    let mut last = Vec::new();
    stream::replay(&mut core, recording, |_, estimate| last.clone_from(&estimate.map_params)).unwrap();
    let quality = core.fit_quality();
    let campaign = Campaign::of(ring, recording).unwrap();
    Fitted {
        core: last.iter().map(|theta| f64::from(*theta)).collect(),
        core_covariance: DMatrix::from_fn(48, 48, |i, j| f64::from(core.covariance(i, j))),
        chi2: f64::from(quality.chi_square / quality.degrees_of_freedom),
        batch: BatchFit::of(&campaign, TuneUse::Readings, |_| ()).unwrap(),
    }
}

impl Fitted {
    /// Largest distance of core and batch, in the batch's error bars; largest ratio of their error bars less 1.
    fn apart(&self) -> [f64; 2] {
        let sigma = |i: usize| self.batch.covariance[(i, i)].sqrt();
        let each = (0..48).map(|i| {
            let theta = (self.core[i] - self.batch.map_params[i]).abs() / sigma(i);
            [theta, (self.core_covariance[(i, i)].sqrt() / sigma(i) - 1.0).abs()]
        });
        let rms = (0..48).map(|i| ((self.core[i] - self.batch.map_params[i]) / sigma(i)).powi(2)).sum::<f64>() / 48.0;
        print!(" rms {:.3} ", rms.sqrt());
        each.fold([0.0; 2], |most, this| [most[0].max(this[0]), most[1].max(this[1])])
    }

    fn nees(&self, vars: &[f64]) -> [f64; 2] {
        [nees(&self.core, &self.core_covariance, vars), nees(&self.batch.map_params, &self.batch.covariance, vars)]
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn vars_are_those_of_the_machine_at_four_times_in_the_cycle() {
    let ring = with_ramp();
    for seed in [11, 12, 13] {
        let vars = simulate::vars(&ring, true, seed).unwrap();
        let truth = Truth { vars, apart: std::env::var("APART").map_or(3e-4, |v| v.parse().unwrap()), seed };
        let started = std::time::Instant::now();
        let recording = through_files(&campaign(&truth), &ring).unwrap();
        println!("made in {:?}", started.elapsed());
        let fitted = fitted(&ring, &recording);
        println!(
            "seed {seed}: nees {:?} apart {:?} chi2 {} {} in {:?}",
            fitted.nees(&truth.vars),
            fitted.apart(),
            fitted.chi2,
            fitted.batch.chi2_per_dof,
            started.elapsed()
        );
    }
}
