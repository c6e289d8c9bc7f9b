#![allow(missing_docs, clippy::all)]
use inference::diagnose::{
    data::Data,
    discrepancy,
    fit::Fitted,
    hypothesis::{Hypothesis, Term},
    scan,
};
use inference::{
    Recording,
    prove::{Case, Class},
    simulate, stream,
};
fn main() {
    let ring = twin::Ring::booster();
    let rec = Recording::read(std::path::Path::new("recordings/paper-vars"), &stream::layout(&ring)).unwrap();
    let d0 = Data::of(&ring, &rec).unwrap();
    let terms = scan::candidates(&d0, rec.header.radial_loop_monitors.as_ref());
    for i in 0..8 {
        let case = Case::draw(&ring, &rec, &terms, Class::Pair, Class::Pair as usize * 1_000_000 + i, 1);
        if !case.effects.iter().any(|e| e.kind == twin::EffectKind::BpmSwap) {
            continue;
        }
        let hw = simulate::Hardware::shipped(&ring, &rec);
        let truth = simulate::Truth { vars: &case.vars, effects: &case.effects, beyond: &[] };
        let r = simulate::campaign(&rec, &ring, &truth, &hw, case.seed).unwrap();
        let data = Data::of(&ring, &r).unwrap();
        let zero = nalgebra::DVector::zeros(48);
        println!("{:?}", case.effects);
        for (b, h) in data.health().iter().enumerate() {
            if h.state != estimator::MonitorState::Ok || data.frames(b).len() < 330 {
                println!("   {} {:?} {} {}", ring.monitor_names()[b], h.state, h.weighted_as, data.frames(b).len());
            }
        }
        let f0 = Fitted::of(&data, &Hypothesis::default(), &zero).unwrap();
        let s = case.effects.iter().find(|e| e.kind == twin::EffectKind::BpmSwap).unwrap();
        let fs = Fitted::of(&data, &Hypothesis::default().with(Term::new(s.kind, &s.place)), &zero).unwrap();
        println!("null {} swap {} gain {}", f0.cost, fs.cost, fs.log_evidence - f0.log_evidence);
        let mut c = scan::scan(&data, &f0, &terms).unwrap();
        c.sort_by(|a, b| b.log_bayes.total_cmp(&a.log_bayes));
        for k in c.iter().take(5) {
            println!("  map {} {}", k.term.label(), k.log_bayes);
        }
        println!("  rank of swap {:?}", c.iter().position(|k| k.term.kind == s.kind && k.term.place == s.place));
        let st = Fitted::unfitted(&data, &Hypothesis::default()).unwrap();
        let mut c = scan::scan(&data, &st, &terms).unwrap();
        c.sort_by(|a, b| b.log_bayes.total_cmp(&a.log_bayes));
        for k in c.iter().take(5) {
            println!("  zero {} {}", k.term.label(), k.log_bayes);
        }
        println!("  rank of swap {:?}", c.iter().position(|k| k.term.kind == s.kind && k.term.place == s.place));
        let mut d = discrepancy::scan(&data, &f0).unwrap();
        d.sort_by(|a, b| b.log_bayes.total_cmp(&a.log_bayes));
        for k in d.iter().take(4) {
            println!("  {} {}", k.at.phrase(&data), k.log_bayes);
        }
    }
}
