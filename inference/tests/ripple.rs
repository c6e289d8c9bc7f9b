//! The orbit of misaligned quadrupoles follows the ripple of their supplies: the fit of exact closed orbits, where that is largest.

use std::path::Path;

use inference::simulate::{self, Hardware, Truth};
use inference::{BatchFit, Campaign, Recording, TuneUse};
use twin::{Hold, Optics, Ring};

#[test]
fn explore() {
    let ring = Ring::booster();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/paper-vars");
    let template = Recording::read(&folder, &ring).unwrap();
    let hardware = Hardware::shipped(&ring, &template);
    for seed in 0..300 {
        let vars = simulate::vars(&ring, true, seed).unwrap();
        let tune = Optics::of(&ring.with_vars(&vars), Hold::Momentum { delta: 0.0 }).unwrap().tunes().unwrap().x;
        if !(4.862..4.88).contains(&tune) {
            continue;
        }
        let truth = Truth { vars: &vars, ..Truth::default() };
        let Ok(recording) = simulate::campaign(&template, &ring, &truth, &hardware, seed) else { continue };
        let t = std::time::Instant::now();
        let mut campaign = Campaign::of(&ring, &recording).unwrap();
        let screened = t.elapsed();
        let fit = BatchFit::of(&campaign, TuneUse::Readings, |_| ()).unwrap();
        let took = t.elapsed();
        let nees = |fit: &BatchFit| {
            let off = nalgebra::DVector::from_fn(48, |i, _| fit.map_params[i] - vars[i].ln());
            off.dot(&fit.covariance.clone().cholesky().unwrap().solve(&off)) / 48.0
        };
        let (new, new_nees) = (fit.chi2_per_dof, nees(&fit));
        let ripple = campaign.ripple.clone();
        campaign.ripple.iter_mut().for_each(|r| *r = [0.0; 2]);
        let fit = BatchFit::of(&campaign, TuneUse::Readings, |_| ()).unwrap();
        println!(
            "{seed} {tune:.4} orbit {:.2e} ripple {:?} chi2 {:.4} -> {new:.4} nees {:.2} -> {new_nees:.2}, {screened:?} {took:?}",
            campaign.orbit[0],
            ripple,
            fit.chi2_per_dof,
            nees(&fit)
        );
    }
}
