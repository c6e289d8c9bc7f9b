//! The orbit of misaligned quadrupoles follows the ripple of their supplies: exact closed orbits through the core, next to the integer.
use inference::Recording;
use inference::simulate::{self, Hardware, Truth};
use inference::stream::{self, Walk};
use system_tests::repository;
use twin::{Hold, Optics, Ring};

#[test]
fn explore() {
    let ring = Ring::booster();
    let template = Recording::read(&repository("recordings/paper-vars"), &ring).unwrap();
    let hardware = Hardware::shipped(&ring, &template);
    for seed in 0..300 {
        let vars = simulate::vars(&ring, true, seed).unwrap();
        let tune = Optics::of(&ring.with_vars(&vars), Hold::Momentum { delta: 0.0 }).unwrap().tunes().unwrap().x;
        if !(4.862..4.88).contains(&tune) && seed > 5 {
            continue;
        }
        let truth = Truth { vars: &vars, ..Truth::default() };
        let Ok(recording) = simulate::campaign(&template, &ring, &truth, &hardware, seed) else { continue };
        let mut core = stream::estimator(&ring, &recording, Walk::NONE).unwrap();
        let mut last = None;
        stream::replay(&mut core, &recording, |_, e| last = Some(e.clone())).unwrap();
        let q = core.fit_quality();
        let e = last.unwrap();
        let off = nalgebra::DVector::from_fn(48, |i, _| f64::from(e.map_params[i]) - vars[i].ln());
        let cov = nalgebra::DMatrix::from_fn(48, 48, |i, j| f64::from(core.covariance(i, j)));
        let nees = off.dot(&cov.cholesky().unwrap().solve(&off)) / 48.0;
        println!(
            "{seed} {tune:.4} chi2/dof {:.4} nees {nees:.2} ev {}",
            q.chi_square / q.degrees_of_freedom,
            e.log_evidence
        );
    }
}
