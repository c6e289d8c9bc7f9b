#![allow(missing_docs, clippy::all)]
use inference::diagnose::{data::Data, fit::Fitted, hypothesis::Hypothesis, scan};
use inference::{Recording, stream};
use std::time::Instant;
fn main() {
    let ring = twin::Ring::booster();
    for name in std::env::args().skip(1) {
        let t0 = Instant::now();
        let rec = Recording::read(std::path::Path::new(&name), &stream::layout(&ring)).unwrap();
        let data = match Data::of(&ring, &rec) { Ok(d) => d, Err(e) => { println!("{name}: {e}"); continue } };
        let t1 = Instant::now();
        let null = Fitted::of(&data, &Hypothesis::default(), &nalgebra::DVector::zeros(48)).unwrap();
        let t2 = Instant::now();
        let terms = scan::candidates(&data, rec.header.radial_loop_monitors.as_ref());
        let mut c = scan::scan(&data, &null, &terms).unwrap();
        let t3 = Instant::now();
        c.sort_by(|a, b| b.log_bayes.total_cmp(&a.log_bayes));
        println!("{name}: n {} chi2 {:.3} cost {:.1} {} candidates; data {:?} fit {:?} scan {:?}", data.len(), null.residual.norm_squared()/data.len() as f64, null.cost, c.len(), t1-t0, t2-t1, t3-t2);
        for k in c.iter().take(6) {
            let t = Instant::now();
            let f = Fitted::of(&data, &Hypothesis::default().with(k.term.clone()), &null.u);
            match f { Ok(f) => { let (a, s) = f.amplitude(&data, 0);
              println!("   {:30} lin {:8.2} exact {:8.2} amp {:.4} +- {:.4}  cost {:.1} power {:.1} {:?}", k.term.label(), k.log_bayes, f.log_evidence - null.log_evidence, a, s, null.cost - f.cost, k.power, t.elapsed()) }
              Err(e) => println!("   {:30} lin {:8.2} {e}", k.term.label(), k.log_bayes) }
        }
    }
}
