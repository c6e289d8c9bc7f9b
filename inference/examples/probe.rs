#![allow(missing_docs, clippy::all)]
use inference::diagnose::{data::Data, heldout, scan, search::{Search, Cause, Slot}};
use inference::{Recording, stream};
use std::time::Instant;
fn show(data: &Data, slot: &Slot) {
    println!("     nothing {:.4} library {:.4} unknown {:.4}", slot.nothing, slot.library(), slot.unknown());
    for a in slot.alternatives.iter().take(4) {
        let l = match &a.cause { Cause::Effect(t) => t.label(), Cause::Unknown(d) => format!("? {}", d.at.phrase(data)) };
        println!("       {:45} p {:.4} gain {:.2} amp {:.5} +- {:.5}", l, a.probability, a.log_gain, a.amplitude.0, a.amplitude.1);
    }
}
fn main() {
    let ring = twin::Ring::booster();
    for name in std::env::args().skip(1) {
        let t0 = Instant::now();
        let rec = Recording::read(std::path::Path::new(&name), &stream::layout(&ring)).unwrap();
        let data = match Data::of(&ring, &rec) { Ok(d) => d, Err(e) => { println!("{name}: {e}"); continue } };
        let t1 = Instant::now();
        let terms = scan::candidates(&data, rec.header.radial_loop_monitors.as_ref());
        let found = Search::new(&data, terms).run().unwrap();
        let t2 = Instant::now();
        println!("{name}: {} data {:?} search {:?}", found.best.hypothesis.label(), t1-t0, t2-t1);
        for s in &found.null.hypothesis.scatter { println!("   scatter {} {}", s.kind.word(), s.width); }
        for s in &found.slots { show(&data, s); }
        println!("   next:"); show(&data, &found.next);
        if let Ok(truth) = std::fs::read_to_string(format!("{name}/truth.json")) {
            let v: serde_json::Value = serde_json::from_str(&truth).unwrap();
            let names = ring.var_names();
            for f in [&found.null, &found.best] {
                let d = nalgebra::DVector::from_iterator(48, names.iter().zip(&f.params).map(|(n, p)| p - v["vars"][n].as_f64().unwrap().ln()));
                let nees = d.dot(&f.covariance().cholesky().unwrap().solve(&d)) / 48.0;
                print!("   NEES {nees:.2}");
            }
            println!("  truth {}", v["effects"]);
        }
        let folds = heldout::by_repeat(&rec);
        let t3 = Instant::now();
        if !found.slots.is_empty() {
            let a = heldout::Score::of(&data, &found.best, &folds).unwrap();
            for s in &found.slots {
                let b = heldout::Score::of(&data, &s.without, &folds).unwrap();
                let (g, se) = a.gain_over(&b);
                println!("   heldout gain {g:.1} +- {se:.1} = {:.1} SE; rms {:.2} -> {:.2} um inside {:?} {:?} {:?}", g/se, b.rms*1e6, a.rms*1e6, b.inside, a.inside, t3.elapsed());
            }
        }
    }
}
