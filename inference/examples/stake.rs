#![allow(missing_docs, clippy::all)]
use inference::diagnose::{Diagnosis, data::Data, scan};
use inference::{
    Recording,
    prove::{Case, Class},
    simulate, stream,
};
fn show(name: &str, d: &Diagnosis) {
    let c = d.vars_before.covariance.clone();
    let inv = c.clone().cholesky().unwrap().inverse();
    let t = (&inv * &d.vars_after.covariance).trace() / 48.0;
    let l = c.cholesky().unwrap().l();
    let li = l.try_inverse().unwrap();
    let m = &li * &d.vars_after.covariance * li.transpose();
    let e = m.symmetric_eigen().eigenvalues.max();
    println!("{name} {} nothing {:.3} trace {t:.3} max eig {e:.2}", d.verdict.word(), d.found.nothing());
    let mut v: Vec<(f64, String)> = d
        .found
        .next
        .alternatives
        .iter()
        .filter(|a| a.adapting.len() > 0)
        .map(|a| {
            let shift = a.adapting.rows(0, 48) * inference::diagnose::fit::prior().1;
            let l = match &a.cause {
                inference::diagnose::search::Cause::Effect(t) => t.label(),
                _ => "?".into(),
            };
            (
                a.probability * (shift.transpose() * &inv * &shift)[0],
                format!("{l} p {:.4} shift2 {:.0}", a.probability, (shift.transpose() * &inv * &shift)[0]),
            )
        })
        .collect();
    v.sort_by(|a, b| b.0.total_cmp(&a.0));
    for x in v.iter().take(3) {
        println!("      {:.2} {}", x.0, x.1);
    }
}
fn main() {
    let ring = twin::Ring::booster();
    let lay = stream::layout(&ring);
    for i in [0usize; 0] {
        let rec =
            Recording::read(std::path::Path::new(&format!("/work/shared/recordings/concealed/open-{i:02}")), &lay)
                .unwrap();
        show(&format!("open-{i:02}"), &Diagnosis::of(&ring, &rec, |_| {}).unwrap());
    }
    let rec = Recording::read(std::path::Path::new("recordings/paper-vars"), &lay).unwrap();
    let d0 = Data::of(&ring, &rec).unwrap();
    let terms = scan::candidates(&d0, rec.header.radial_loop_monitors.as_ref());
    for i in [16, 22, 11] {
        let case = Case::draw(&ring, &rec, &terms, Class::Empty, i, 77);
        let hw = simulate::Hardware::shipped(&ring, &rec);
        let truth = simulate::Truth { vars: &case.vars, effects: &case.effects, beyond: &[] };
        let r = simulate::campaign(&rec, &ring, &truth, &hw, case.seed).unwrap();
        let d = Diagnosis::of(&ring, &r, |_| {}).unwrap();
        show(&format!("empty {i}"), &d);
        println!("{}", d.sentence);
        for s in d.found.slots.iter().chain([&d.found.next]) {
            println!("  nothing {:.4}", s.nothing);
            for a in s.alternatives.iter().take(6) {
                println!(
                    "    {} gain {:.2} p {:.3} amp {:?}",
                    match &a.cause {
                        inference::diagnose::search::Cause::Effect(t) => t.label(),
                        inference::diagnose::search::Cause::Unknown(u) => u.at.phrase(&d.found.data),
                    },
                    a.log_gain,
                    a.probability,
                    a.amplitude
                );
            }
        }
        println!(
            "{:?} vars at bounds {:?} tunes {:?}",
            d.gain(),
            case.vars.iter().filter(|v| (**v - 1.0).abs() > 0.055).collect::<Vec<_>>(),
            d.found.null.residual.rows(d.found.null.residual.len() - 4, 4).transpose()
        );
    }
}
