//! The orbit of misaligned quadrupoles follows the ripple of their supplies, and adds to the dispersion: exact closed orbits through
//! the core.

use inference::Recording;
use inference::simulate::{self, Hardware, Truth};
use inference::stream::{self, Walk};
use system_tests::repository;
use twin::Ring;

/// chi2/dof of a simulated campaign after the core has taken it in.
fn chi2_per_dof(ring: &Ring, template: &Recording, seed: u64) -> f64 {
    let vars = simulate::vars(ring, true, seed).unwrap();
    let truth = Truth { vars: &vars, ..Truth::default() };
    let hardware = Hardware::shipped(ring, template);
    let recording = simulate::campaign(template, ring, &truth, &hardware, seed).unwrap();
    let mut core = stream::estimator(ring, &recording, Walk::NONE).unwrap();
    stream::replay(&mut core, &recording, |_, _| ()).unwrap();
    let quality = core.fit_quality();
    // 10,647 degrees of freedom, or 10,989 where x_C6 counts: a standard deviation of 1.37 %
    assert!(quality.degrees_of_freedom > 10_600.0, "{seed}: {quality:?}");
    f64::from(quality.chi_square / quality.degrees_of_freedom)
}

/// 2.9 standard deviations: one campaign in 280 lies outside by chance. Of those of the seeds 0 to 399 one does, at 0.959; all have a
/// mean of 0.9997 and a standard deviation of 0.0131.
const BAR: core::ops::Range<f64> = 0.96..1.04;

fn is_within_the_bar(seeds: impl IntoIterator<Item = u64>) {
    let ring = Ring::booster();
    let template = Recording::read(&repository("recordings/paper-vars"), &ring).unwrap();
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

/// Ten more, on which nothing was chosen: what is common to all would show in their mean, of a standard deviation of 0.44 %.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn chi_square_is_its_degrees_of_freedom() {
    let ring = Ring::booster();
    let template = Recording::read(&repository("recordings/paper-vars"), &ring).unwrap();
    let mean = (1001..=1010).map(|seed| chi2_per_dof(&ring, &template, seed)).sum::<f64>() / 10.0;
    assert!((mean - 1.0).abs() < 3.0 * 0.0137 / 10.0_f64.sqrt(), "{mean}");
}
