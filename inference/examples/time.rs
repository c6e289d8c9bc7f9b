#![allow(missing_docs, clippy::all)]
use inference::diagnose::{data::Data, discrepancy, fit::Fitted, heldout, hypothesis::Hypothesis, scan};
use inference::{Recording, stream};
use std::time::Instant;
fn main() {
    let ring = twin::Ring::booster();
    let name = std::env::args().nth(1).unwrap();
    let rec = Recording::read(std::path::Path::new(&name), &stream::layout(&ring)).unwrap();
    let t = Instant::now();
    let s = inference::map::screen(&ring, &rec).unwrap();
    println!("screen {:?} {}", t.elapsed(), s.health.len());
    let t = Instant::now();
    let data = Data::of(&ring, &rec).unwrap();
    println!("data {:?}", t.elapsed());
    let t = Instant::now();
    let f = Fitted::of(&data, &Hypothesis::default(), &nalgebra::DVector::zeros(48)).unwrap();
    println!("fit from zero {:?}", t.elapsed());
    let t = Instant::now();
    let f2 = Fitted::of(&data, &Hypothesis::default(), &f.u).unwrap();
    println!("refit {:?} {}", t.elapsed(), f2.cost);
    let terms = scan::candidates(&data, None);
    let t = Instant::now();
    let c = scan::scan(&data, &f, &terms).unwrap();
    println!("scan {:?} {}", t.elapsed(), c.len());
    let t = Instant::now();
    let c = discrepancy::scan(&data, &f).unwrap();
    println!("discrepancy {:?} {}", t.elapsed(), c.len());
    let t = Instant::now();
    let folds = heldout::by_repeat(&rec);
    let c = heldout::Score::of(&data, &f, &folds).unwrap();
    println!("heldout {:?} {}", t.elapsed(), c.elpd());
    let t = Instant::now();
    let m = f.jacobian.transpose() * &f.jacobian;
    println!("JtJ {:?} {}", t.elapsed(), m[(0, 0)]);
    let t = Instant::now();
    let (mach, drives) = f.hypothesis.machine(&data, &f.params, &[]).unwrap();
    println!("machine {:?}", t.elapsed());
    let t = Instant::now();
    let r = mach.readings(&drives).unwrap();
    println!("readings {:?} {}", t.elapsed(), r.0.len());
    let t = Instant::now();
    let sg = twin::Signatures::of(&mach, &drives).unwrap();
    println!("signatures {:?}", t.elapsed());
    let t = Instant::now();
    let v = sg.of_vars();
    println!("of_vars {:?} {}", t.elapsed(), v.len());
    let t = Instant::now();
    for s in &v {
        std::hint::black_box(data.signature(s));
    }
    println!("whiten 48 {:?}", t.elapsed());
}
