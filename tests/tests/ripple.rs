//! The orbit of misaligned quadrupoles follows the ripple of their supplies, and adds to the dispersion: exact closed orbits through
//! the core.

use estimator::booster::PARAMS;
use estimator::surrogate::Prediction;
use estimator::{Drive, Surrogate};
use inference::Recording;
use inference::simulate::{self, Hardware, Truth};
use inference::stream::{self, Core, Walk};
use system_tests::machine::nees;
use system_tests::{cells, recording};
use twin::Ring;

/// The core after a simulated campaign, its best params, and the true ones.
fn after_campaign(ring: &Ring, template: &Recording, seed: u64) -> (Core, [[f64; PARAMS]; 2]) {
    let vars = simulate::vars(ring, true, seed).unwrap();
    let truth = Truth { vars: &vars, ..Truth::default() };
    let hardware = Hardware::shipped(ring, template);
    let recording = simulate::campaign(template, ring, &truth, &hardware, seed).unwrap();
    let (mut core, mut best) = (stream::estimator(ring, &recording, Walk::NONE).unwrap(), [0.0; PARAMS]);
    stream::replay(&mut core, &recording, |_, estimate| {
        best = core::array::from_fn(|i| f64::from(estimate.map_params[i]));
    })
    .unwrap();
    (core, [best, core::array::from_fn(|i| vars[i].ln())])
}

/// chi2/dof of a simulated campaign after the core has taken it in.
fn chi2_per_dof(ring: &Ring, template: &Recording, seed: u64) -> f64 {
    let (mut core, _) = after_campaign(ring, template, seed);
    let quality = core.fit_quality();
    // 10,647 degrees of freedom, or 10,989 where x_C6 counts: a standard deviation of 1.37 %. 15 frames less, of no setting, until it is known where the
    // correctors of the deck's campaign stand
    assert!(quality.degrees_of_freedom > 10_150.0, "{seed}: {quality:?}");
    f64::from(quality.chi_square / quality.degrees_of_freedom)
}

/// 2.9 standard deviations: one campaign in 280 lies outside by chance. Of those of the seeds 0 to 399 one does, at 0.959; all have a
/// mean of 0.9997 and a standard deviation of 0.0131.
const BAR: core::ops::Range<f64> = 0.96..1.04;

/// On the ring whose seeds were looked through.
fn is_within_the_bar(seeds: impl IntoIterator<Item = u64>) {
    let (ring, template) = recording("former/paper-vars");
    for seed in seeds {
        let chi2 = chi2_per_dof(&ring, &template, seed);
        assert!(BAR.contains(&chi2), "{seed}: chi2/dof {chi2}");
    }
}

/// Machines with horizontal tunes of 4.8685, 4.8738 and 4.8708, whose chi2/dof is 1.07 to 1.28 if baselines stay.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn baselines_follow_the_supplies() {
    is_within_the_bar([119, 95, 261]);
}

/// Of the seeds 0 to 399 those in which two settings of 80, those with an RF offset, make chi2/dof 1.29, 1.24 and 1.15 if the
/// dispersion is that of an aligned ring.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn spurious_dispersion_is_no_mismatch() {
    is_within_the_bar([331, 16, 268]);
}

/// Forty machines on which nothing was chosen. Were the spurious dispersion taken for each monitor's own, their mean would be 1.045.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn vars_are_as_certain_as_is_said() {
    let (ring, template) = recording("paper-vars");
    let per_var = |seed| {
        let (core, [best, truth]) = after_campaign(&ring, &template, seed);
        nees(&core::array::from_fn(|i| best[i] - truth[i]), |i, j| core.covariance(i, j)) / PARAMS as f64
    };
    let all: Vec<f64> = (2001..=2040).map(per_var).collect();
    let mean = all.iter().sum::<f64>() / 40.0;
    println!("NEES/48: {mean:.3} on average, {:.2} at most", all.iter().copied().fold(0.0, f64::max));
    // 1.10 measured, as of the batch fit; 0.95 without the sextupoles of the dipoles, a gradient where an orbit of some mm crosses them, which no linear
    // model has. A mean of 40 has a standard deviation of sqrt(2/(40 48)) = 0.032
    assert!((0.87..1.2).contains(&mean), "{mean}");
    // 2.14 measured; of chi-square with 48 degrees of freedom one in 10,000 is beyond 1.87 per degree
    assert!(all.iter().all(|nees| *nees < 2.3), "{all:?}");
}

/// Ten more, on which nothing was chosen: what is common to all would show in their mean, of a standard deviation of 0.44 %.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn chi_square_is_its_degrees_of_freedom() {
    let (ring, template) = recording("paper-vars");
    let mean = (1001..=1010).map(|seed| chi2_per_dof(&ring, &template, seed)).sum::<f64>() / 10.0;
    assert!((mean - 1.0).abs() < 3.0 * 0.0137 / 10.0_f64.sqrt(), "{mean}");
}

/// Rms change of orbits per `ln` of each supply's factor over their rms, in x and y: of a sample of the instruments, and of kicks by every corrector at every
/// monitor.
fn followed<const B: usize, const C: usize, const F: usize, const N: usize, G: Surrogate<B, C, F, N>>(
    tables: &G,
) -> [[[f64; 2]; 2]; 2] {
    let (mut drive, mut prediction) = (Drive::NONE, Box::new(Prediction::BLANK));
    let mut at = Box::new(G::UNLINEARISED);
    tables.linearise(&[0.0; N], &[0.0; F], &mut at).unwrap();
    let layout = tables.layout();
    let in_plane = |[x, y]: [u16; 2], plane: usize| {
        let (x, y) = (usize::from(x), usize::from(y));
        if plane == 0 { 0..x } else { x..x + y }
    };
    let by_all = [0, 1].map(|plane| {
        let (mut changes, mut size) = ([0.0; 2], 0.0);
        for c in in_plane(layout.ring.correctors, plane).map(|c| layout.corrector(c)) {
            drive.kick[c] = 1e-3;
            tables.predict(&at, &drive, &mut prediction);
            drive.kick[c] = 0.0;
            for b in in_plane(layout.ring.monitors, plane).map(|b| layout.monitor(b)) {
                size += f64::from(prediction.reading[b]).powi(2);
                let each = changes.iter_mut().zip(&prediction.by_supply[b]);
                each.for_each(|(change, slope)| *change += f64::from(*slope).powi(2));
            }
        }
        changes.map(|change| (change / size).sqrt())
    });
    let by_sample = [0, 1].map(|plane| {
        let (ratios, _) = tables.follow(&at, plane);
        [0, 1].map(|supply| f64::from(ratios[supply]))
    });
    [by_sample, by_all]
}

/// Where a plane has more than 64 monitors or correctors a sample of them is taken: off by 1.3 % at most here.
#[test]
#[cfg_attr(debug_assertions, ignore = "a minute without optimisation")]
fn a_sample_of_instruments_tells_how_orbits_follow_the_supplies() {
    training::with_stack(|| {
        for (number, further) in [(64, 64), (80, 40), (100, 20), (127, 0), (256, 64)] {
            let tables = training::green::tables(&cells::ring(number, further)).unwrap();
            let [by_sample, by_all] = training::in_spare_room!(tables.sizes(), |room| {
                let mut own = Box::new(room::Green::BLANK);
                tables.fill(&mut *own).unwrap();
                followed::<{ room::MONITORS }, { room::CORRECTORS }, { room::SUPPLIES }, { room::PARAMS }, _>(&*own)
            })
            .unwrap();
            for (sample, all) in by_sample.as_flattened().iter().zip(by_all.as_flattened()) {
                assert!((sample / all - 1.0).abs() < 0.014, "{number} cells: {sample} by a sample, {all} by all");
            }
        }
    });
}
