//! An unmodelled discrepancy: a part of the data that no effect of the library describes, and its most likely location.
//!
//! Each place is tried with free amplitudes: one of standard deviation `omega` for every setting (or stretch of time) at a monitor, a
//! corrector or a place in the ring that kicks the beam, and for every run of a setting or stretch of time at a quadrupole whose gradient changes (`discrepancy/gradient.rs`); an unknown linear element those of the terms of its Hamiltonian, as a solenoid or a wiggler would have them. With `Z` the whitened pattern of those amplitudes,
//! `P` the projection that removes what the fit's unknowns can absorb, `g = Z^T P r` and `G = Z^T P Z`:
//!
//! `ln Bayes factor = -ln det(1 + omega^2 G)/2 + omega^2 g (1 + omega^2 G)^-1 g/2`,
//!
//! ([`evidence`]), averaged over omega from well below the noise to millimetres. It assumes nothing of the physics; the determinant corrects for the
//! number of free amplitudes.
//!
//! Sums are taken monitor by monitor (`discrepancy/sums.rs`).
//!
//! Source: M. C. Kennedy and A. O'Hagan, J. R. Stat. Soc. B 63 (2001) 425, a model's discrepancy; variance components.

mod gradient;
mod marginal;
mod sums;

use estimator::MonitorState;
use nalgebra::{DMatrix, DVector, DVectorView};
use twin::{Plane, Signature, Signatures};

use super::data::Data;
use super::element::{Element, Form, Linear};
use super::fit::{FitError, Fitted};
use super::location::Location;
pub use gradient::steering;
use gradient::{Changing, Runs, Where};
use marginal::Linearised;
pub use marginal::{Discrepancy, SIZES};
use sums::{Apart, Seen, Sums, at_monitors};

/// Stretches of time.
const STRETCHES: usize = 8;
/// Least norm that a column of norm 1 has at right angles to those before it.
const DEPENDENT: f64 = 1e-8;
/// Highest power of the position that a monitor's reading may contain.
const POWERS: usize = 5;

/// Try every place in turn; those with a `ln` Bayes factor below `least` are of no account.
///
/// # Errors
/// [`FitError`].
pub fn scan(data: &Data, fitted: &Fitted, least: f64) -> Result<Vec<Discrepancy>, FitError> {
    let data = fitted.data(data);
    let mut all = Vec::new();
    for campaign in 0..data.count() {
        let of_one = scan_of(data, campaign, fitted, least)?;
        // each recording has free amplitudes of its own
        all.extend(of_one.into_iter().map(|one| Discrepancy { campaign, sites: one.sites * data.count(), ..one }));
    }
    Ok(all)
}

/// Every place in one of several recordings.
fn scan_of(all: &Data, campaign: usize, fitted: &Fitted, least: f64) -> Result<Vec<Discrepancy>, FitError> {
    let data = all.campaign(campaign);
    let linearised = Linearised::from_fit(fitted, least);
    let whitened = Seen::from_fit(fitted, all.parts().swap_remove(campaign));
    let settings = &data.settings;
    let monitors = data.monitors();
    let seen = Seen::taken_back(data, &whitened);
    let sums: Vec<Sums> = (0..monitors).map(|b| data.sums(b, &seen, &settings.indicator())).collect();
    let apart: Vec<Apart> = (0..monitors).map(|b| Apart::from_sums(data, b, settings, &sums[b])).collect();
    let stretches = stretches(data);
    let steps: Vec<Sums> = (0..monitors).map(|b| data.sums(b, &seen, &stretches)).collect();
    // faulty monitors scatter by themselves
    let healthy = |&b: &usize| data.health()[b].state == MonitorState::Ok;
    let active: Vec<usize> = data.active_monitors().into_iter().filter(healthy).collect();
    if active.is_empty() {
        return Ok(Vec::new());
    }
    let (machine, drives) = fitted.machine_on_orbit(all, campaign)?;
    let predicted = fitted.predicted(all, campaign)?;
    let signatures = Signatures::of(&machine, &drives)?;
    let mut found = Vec::new();
    for &b in &active {
        found.push(linearised.judge(Location::Monitor(b), &sums[b], active.len()));
        found.push(linearised.judge(Location::MonitorInTime(b), &steps[b], active.len()));
        let gains = data.sums(b, &seen, &scaled(&stretches, &predicted.column(b)));
        found.push(linearised.judge(Location::GainInTime(b), &gains, active.len()));
        let orbit = signatures.around(b);
        let elsewhere = data.sums(b, &seen, &independent(orbit.clone()));
        found.push(linearised.judge(Location::MonitorElsewhere(b), &elsewhere, active.len()));
        let curve = data.sums(b, &seen, &independent(powers(&orbit.column(0))));
        found.push(linearised.judge(Location::MonitorCurve(b), &curve, active.len()));
    }
    let driven = data.driven_correctors();
    for &c in &driven {
        let of_corrector = settings.with_corrector(c);
        let (of_each, apart): (Vec<Sums>, Vec<Apart>) =
            active.iter().map(|&b| (sums[b].select(&of_corrector), apart[b].select(&of_corrector))).unzip();
        found.push(linearised.judge_apart(Location::Corrector(c), &of_each, &apart, driven.len()));
        let patterns = independent(signatures.beside(c));
        let beside = patterned(data, &sums, &active, &settings.strength_of(c), &patterns);
        found.push(linearised.judge(Location::CorrectorElsewhere(c), &beside, driven.len()));
    }
    let patterns = kicked(&machine)?;
    let sites = patterns.len();
    for (quadrupole, plane, pattern) in &patterns {
        let of_settings = weighted(data, &sums, &active, pattern);
        found.push(linearised.judge(Location::Ring(*quadrupole, *plane), &of_settings, sites));
        let of_stretches = weighted(data, &steps, &active, pattern);
        found.push(linearised.judge(Location::RingInTime(*quadrupole, *plane), &of_stretches, sites));
    }
    let sites = Linear::ALL.len() * data.ring.quadrupoles.len();
    for q in 0..data.ring.quadrupoles.len() {
        let forms = Element::signatures(&signatures, &data.ring, q);
        let of_rms_1 = |(_, one): &(Form, Signature)| Ok(Some(at_monitors(one, &active) * one.rms().recip()));
        let mut columns = DMatrix::zeros(data.size(), forms.len());
        data.signatures::<FitError>(columns.as_view_mut(), forms.iter().map(of_rms_1))?;
        let of_all = Sums::from_columns(&columns, &whitened);
        for does in Linear::ALL {
            let some: Vec<usize> = (0..forms.len()).filter(|&i| does.has(forms[i].0)).collect();
            found.push(linearised.judge(Location::Linear(q, does), &of_all.select(&some), sites));
        }
    }
    let changing = Changing::all(&signatures, machine.ring(), &drives.orbit, &data.baseline.sigma);
    let tunes: Vec<Sums> = [0, 1].into_iter().filter_map(|plane| data.tune_sums(plane, &seen, &stretches)).collect();
    let at =
        Where { data, own: &whitened, monitors: &active, runs: Runs::from_readings(data, &seen, &active), stretches };
    found.extend(linearised.changing(&at, &changing));
    found.push(linearised.judge_held(Location::Tunes, &tunes.iter().collect::<Vec<_>>()));
    found.push(linearised.judge_held(Location::Time, &some(&steps, &active)));
    found.push(linearised.judge_held(Location::Everywhere, &some(&sums, &active)));
    Ok(found)
}

fn some<'c>(sums: &'c [Sums], monitors: &[usize]) -> Vec<&'c Sums> {
    monitors.iter().map(|&b| &sums[b]).collect()
}

/// Steps at the edges of the stretches of time: rows pools, columns edges.
fn stretches(data: &Data) -> DMatrix<f64> {
    let edge = |i: usize| -1.0 + 2.0 * (i + 1) as f64 / STRETCHES as f64;
    DMatrix::from_fn(data.readings.nrows(), STRETCHES - 1, |frame, i| {
        f64::from(u8::from(data.drives.time[frame] >= edge(i))) - 0.5
    })
}

/// Steps of a gain about its mean: the steps times the predicted readings, scaled to rms 1, less their projection on these.
fn scaled(stretches: &DMatrix<f64>, predicted: &DVectorView<f64>) -> DMatrix<f64> {
    let rms = (predicted.norm_squared() / predicted.len() as f64).sqrt().max(f64::MIN_POSITIVE);
    let mut columns = stretches.clone();
    columns.row_iter_mut().zip(predicted.iter()).for_each(|(mut row, p)| row *= p / rms);
    let share = predicted.tr_mul(&columns) / predicted.norm_squared().max(f64::MIN_POSITIVE);
    columns - predicted * share
}

/// The powers of a position, from the first on.
fn powers(position: &DVectorView<f64>) -> DMatrix<f64> {
    let scale = position.amax().max(f64::MIN_POSITIVE);
    DMatrix::from_fn(position.len(), POWERS, |i, power| (position[i] / scale).powi(power as i32 + 1))
}

/// Orthogonal columns of rms 1 that span the same space; linearly dependent ones are left out.
fn independent(mut columns: DMatrix<f64>) -> DMatrix<f64> {
    let rows = columns.nrows() as f64;
    columns.column_iter_mut().for_each(|mut column| column /= column.norm().max(f64::MIN_POSITIVE));
    let qr = columns.qr();
    let (q, r) = (qr.q(), qr.r());
    let adds: Vec<usize> = (0..r.ncols()).filter(|&i| r[(i, i)].abs() > DEPENDENT).collect();
    q.select_columns(&adds) * rows.sqrt()
}

/// Orbit at the read monitors for a kick at each quadrupole in each plane, scaled to rms 1.
fn kicked(machine: &twin::Machine) -> Result<Vec<(usize, Plane, DVector<f64>)>, FitError> {
    let ring = machine.ring();
    let optics = twin::Optics::of(ring, twin::Hold::Momentum { delta: 0.0 })?;
    let observers = optics.read_monitors();
    let of_plane = |plane: Plane| {
        let direction = if plane == Plane::X { [1.0, 0.0] } else { [0.0, 1.0] };
        let sources: Vec<_> = ring.quadrupoles.iter().map(|q| optics.kick(q.element, direction)).collect();
        let response = optics.response(&observers, &sources);
        (0..sources.len()).map(move |q| {
            let column = response.column(q).into_owned();
            let read = column.iter().filter(|r| r.abs() > 0.0).count().max(1) as f64;
            let rms = (column.norm_squared() / read).sqrt().max(f64::MIN_POSITIVE);
            (q, plane, column / rms)
        })
    };
    Ok(of_plane(Plane::X).chain(of_plane(Plane::Y)).collect())
}

/// One amplitude for each setting or stretch, common to all monitors with a fixed pattern.
fn weighted(data: &Data, sums: &[Sums], monitors: &[usize], pattern: &DVector<f64>) -> Sums {
    let first = &sums[monitors[0]];
    let all = data.accompanied(monitors, pattern);
    let mut sum = Sums::zero(first.cross.nrows(), first.cross.ncols());
    for &b in monitors.iter().filter(|&&b| pattern[b] != 0.0) {
        sum.add(&sums[b], pattern[b], all[b]);
    }
    sum
}

/// One amplitude for each pattern over the monitors (one a column), in proportion to `setting`.
fn patterned(data: &Data, sums: &[Sums], monitors: &[usize], setting: &DVector<f64>, patterns: &DMatrix<f64>) -> Sums {
    let mut sum = Sums::zero(patterns.ncols(), sums[monitors[0]].cross.ncols());
    let mut all = patterns.clone();
    all.column_iter_mut()
        .for_each(|mut pattern| pattern.copy_from(&data.accompanied(monitors, &pattern.clone_owned())));
    for &b in monitors {
        let seen = patterns.row(b).transpose();
        let both = (&seen * all.row(b) + all.row(b).transpose() * seen.transpose()) * 0.5;
        sum.gram += both * setting.dot(&(&sums[b].gram * setting));
        sum.cross += &seen * setting.tr_mul(&sums[b].cross);
        sum.pull += &seen * setting.dot(&sums[b].pull);
    }
    sum
}

#[cfg(test)]
mod tests {
    use inference::simulate;
    use nalgebra::MatrixXx2;
    use validation::{Unmodelled, UnmodelledKind};

    use super::*;
    use crate::hypothesis::Hypothesis;
    use crate::testing::{Coloured, simulated, template, whitened};
    use crate::{Diagnosis, Verdict};

    fn seen_of(data: &Data, fitted: &Fitted) -> Seen {
        Seen::taken_back(data, &Seen::from_fit(fitted, 0..fitted.residual.len()))
    }

    #[test]
    fn the_evidence_taken_monitor_by_monitor_is_that_of_one_large_matrix() {
        let (ring, recording) = template();
        let data = whitened(&ring, &recording);
        let fitted = Fitted::unfitted(&data, &Hypothesis::default()).unwrap();
        let (linearised, settings) = (Linearised::from_fit(&fitted, 0.0), &data.settings);
        let (monitors, some) = ([0, 3, 20], [0, 1, 5, 30, 31, 60]);
        let seen = seen_of(&data, &fitted);
        let sums = monitors.map(|b| data.sums(b, &seen, &settings.indicator()));
        let each = sums.each_ref().map(|sums| sums.select(&some));
        let apart = [0, 1, 2].map(|i| Apart::from_sums(&data, monitors[i], settings, &sums[i]).select(&some));
        for (sums, apart) in each.iter().zip(&apart) {
            let gram = DMatrix::from_diagonal(&apart.alone) - &apart.common * apart.common.transpose();
            assert!((gram - &sums.gram).amax() < 1e-9 * sums.gram.amax(), "rounding");
        }
        let one = linearised.judge(Location::Corrector(0), &Sums::stacked(&each), 1);
        let other = linearised.taken_apart(Location::Corrector(0), &each, &apart, 1);
        assert_eq!(one.size, other.size);
        assert!((one.log_bayes / other.log_bayes - 1.0).abs() < 1e-9, "{} {}", one.log_bayes, other.log_bayes);
    }

    /// A kick that varies by 86 urad is seen as noise that all monitors have in common, and vars were said to be off by millions of per cent.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn vars_that_adapt_stay_where_vars_can_be() {
        let ring = template().0;
        let vars = simulate::vars(&ring, true, 7_752_658_534_036_229_640).unwrap();
        let drift = Unmodelled::of(UnmodelledKind::OrbitDrift, &ring, 7_620_465_084_028_654_614);
        assert_eq!((drift.site.name(&ring).as_str(), (1e6 * drift.size).round()), ("H_B6", 86.0));
        let recording = simulated(&vars, &[], &[&drift], 10_397_415_869_173_073_767);
        let found = Diagnosis::from_recording(&ring, &recording, |_| ()).unwrap();
        assert_eq!(found.verdict, Verdict::Unexplained, "{}", found.sentence);
        let off = found.vars_after.nees(&DVector::from_vec(vars).map(f64::ln));
        println!("{off}");
        assert!(found.beyond.len() < 3 && off < 2.0, "{off}: {}", found.sentence);
    }

    /// Free amplitudes of one monitor, and of all with one pattern, by sums over single monitors and by whole whitened frames.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn sums_of_single_monitors_are_near_those_of_whole_frames() {
        let (ring, recording) = template();
        let white = Coloured::white(&ring, &recording, 5);
        let noise = Coloured { slow: (0.2, 10.0), momentum: 6e-5, crate_share: 0.2, ..white };
        let data = whitened(&ring, &noise.campaign(&ring, &recording, &[]));
        assert!(data.noise.momentum.value > 0.0 && data.noise.crate_share.value > 0.0 && !data.noise.slow.is_none());
        let fitted = Fitted::from_guess(&data, &Hypothesis::default(), &DVector::zeros(data.units.len())).unwrap();
        let (linearised, seen) = (Linearised::from_fit(&fitted, 0.0), seen_of(&data, &fitted));
        let own = Seen::from_fit(&fitted, 0..fitted.residual.len());
        let columns_of = |pattern: &DVector<f64>, indicator: &DMatrix<f64>| {
            let readings = DMatrix::from_fn(data.pools.count, pattern.len(), |_, b| pattern[b]);
            let all = Signature { readings, tunes: [0.0; 2], tune_changes: MatrixXx2::zeros(data.pools.count) };
            data.stepping(&[all], indicator)
        };
        let whole = |pattern: &DVector<f64>, indicator: &DMatrix<f64>| {
            Sums::from_columns(&columns_of(pattern, indicator), &own)
        };
        let evidence = |sums: &Sums| linearised.judge(Location::Time, sums, 1).log_bayes;
        let (monitors, mut largest) = (data.active_monitors(), 0.0_f64);
        let stretches = stretches(&data);
        for &b in &monitors {
            let alone = DVector::from_fn(data.monitors(), |i, _| f64::from(u8::from(i == b)));
            let (near, exact) = (evidence(&data.sums(b, &seen, &stretches)), evidence(&whole(&alone, &stretches)));
            largest = largest.max((near - exact).abs());
        }
        let indicator = data.settings.indicator();
        let sums: Vec<Sums> = (0..data.monitors()).map(|b| data.sums(b, &seen, &indicator)).collect();
        let (machine, drives) = fitted.machine(&data, 0).unwrap();
        let read = |pattern: &DVector<f64>| {
            DVector::from_fn(pattern.len(), |b, _| if monitors.contains(&b) { pattern[b] } else { 0.0 })
        };
        let kicked = kicked(&machine).unwrap();
        let mut of_patterns = 0.0_f64;
        for (_, _, pattern) in kicked.iter().step_by(8) {
            let pattern = read(pattern);
            let near = evidence(&weighted(&data, &sums, &monitors, &pattern));
            of_patterns = of_patterns.max((near - evidence(&whole(&pattern, &indicator))).abs());
        }
        let machine = machine.on_orbit(&drives.orbit);
        let signatures = Signatures::of(&machine, &drives).unwrap();
        let (runs, mut of_quadrupoles) = (Runs::from_readings(&data, &seen, &monitors).unwrap(), 0.0_f64);
        let at = Where { data: &data, own: &own, monitors: &monitors, runs: None, stretches };
        let changing = Changing::all(&signatures, machine.ring(), &drives.orbit, &data.baseline.sigma);
        let each = DMatrix::identity(data.pools.count, data.pools.count);
        for (i, one) in changing.iter().enumerate().step_by(8) {
            let in_runs = runs.of_patterns(&data, &one.patterns);
            let (in_time, exact) = (in_runs.through(&at.stretches), at.stepping(&one.patterns, &at.stretches));
            of_quadrupoles = of_quadrupoles.max((evidence(&in_time) - evidence(&exact)).abs());
            if i == 0 {
                let exact = at.stepping(&one.patterns, &each);
                of_quadrupoles = of_quadrupoles.max((evidence(&in_runs) - evidence(&exact)).abs());
            }
        }
        println!("{largest} {of_patterns} {of_quadrupoles}");
        // measured: 0.003, 0.021 and 0.002 nat; the odds that decide are nats
        assert!(
            largest < 0.02 && of_patterns < 0.05 && of_quadrupoles < 0.02,
            "{largest} nat of single monitors, {of_patterns} nat of patterns, {of_quadrupoles} nat of quadrupoles"
        );
    }
}
