#![allow(missing_docs, clippy::all)]
use inference::diagnose::{
    data::Data,
    heldout, scan,
    search::{Cause, Search, Slot},
};
use inference::{Recording, stream};
use std::time::Instant;
fn show(data: &Data, slot: &Slot) {
    println!("     nothing {:.4} library {:.4} unknown {:.4}", slot.nothing, slot.library(), slot.unknown());
    for a in slot.alternatives.iter().take(4) {
        let l = match &a.cause {
            Cause::Effect(t) => t.label(),
            Cause::Unknown(d) => format!("? {}", d.at.phrase(data)),
        };
        println!(
            "       {:45} p {:.4} gain {:.2} amp {:.5} +- {:.5}",
            l, a.probability, a.log_gain, a.amplitude.0, a.amplitude.1
        );
    }
}
fn main() {
    let ring = twin::Ring::booster();
    for name in std::env::args().skip(1) {
        let t0 = Instant::now();
        let rec = Recording::read(std::path::Path::new(&name), &stream::layout(&ring)).unwrap();
        let data = match Data::of(&ring, &rec) {
            Ok(d) => d,
            Err(e) => {
                println!("{name}: {e}");
                continue;
            }
        };
        let t1 = Instant::now();
        let terms = scan::candidates(&data, rec.header.radial_loop_monitors.as_ref());
        let found = Search::new(data.clone(), terms).run().unwrap();
        let data = found.data.clone();
        let t2 = Instant::now();
        println!("{name}: {} data {:?} search {:?}", found.best.hypothesis.label(), t1 - t0, t2 - t1);
        for s in &found.null.hypothesis.scatter {
            println!("   scatter {} {}", s.kind.word(), s.width);
        }
        for s in &found.slots {
            show(&data, s);
        }
        println!("   next:");
        show(&data, &found.next);
        if let Ok(truth) = std::fs::read_to_string(format!("{name}/truth.json")) {
            let v: serde_json::Value = serde_json::from_str(&truth).unwrap();
            let names = ring.var_names();
            for f in [&found.null, &found.best] {
                let d = nalgebra::DVector::from_iterator(
                    48,
                    names.iter().zip(&f.params).map(|(n, p)| p - v["vars"][n].as_f64().unwrap().ln()),
                );
                let nees = d.dot(&f.covariance().cholesky().unwrap().solve(&d)) / 48.0;
                print!("   NEES {nees:.2}");
            }
            println!("  truth {}", v["effects"]);
        }
        if std::env::var("RES").is_ok() {
            println!("baseline rms {:?}", data.baseline_rms);
            let pol = inference::diagnose::hypothesis::Term::new(twin::EffectKind::CorrectorPolarity, "H_D4");
            let f1 = inference::diagnose::fit::Fitted::of(&data, &Default::default(), &nalgebra::DVector::zeros(48))
                .unwrap();
            let hyp = inference::diagnose::hypothesis::Hypothesis::default().with(pol);
            for g in [&f1.u, &nalgebra::DVector::zeros(48)] {
                let f = inference::diagnose::fit::Fitted::of(&data, &hyp, g).unwrap();
                println!("polarity from guess: cost {} ev {} umax {}", f.cost, f.log_evidence, f.u.amax());
                let mut c = scan::scan(&data, &f, &scan::candidates(&data, None)).unwrap();
                c.sort_by(|a, b| b.log_bayes.total_cmp(&a.log_bayes));
                for k in c.iter().take(8) {
                    println!("     {} {} {} power {}", k.term.label(), k.log_bayes, k.amplitude, k.power);
                }
            }

            let f = &found.slots[0].without;
            let f = if found.slots.len() > 1 { &found.slots[1].without } else { &found.best };
            let _ = f;
            for (r, p) in f.residual.iter().zip(data.places()) {
                if r.abs() > 4.0 {
                    if let Some((i, b)) = p {
                        println!(
                            "    frame {i} {:?} {} monitor {} z {r:.1}",
                            rec.rows[i].corrector,
                            rec.rows[i].setting,
                            ring.monitor_names()[b]
                        );
                    }
                }
            }
            for (b, h) in data.health().iter().enumerate() {
                println!(
                    "   {} {:?} {:.3} rej {} counted {}",
                    ring.monitor_names()[b],
                    h.state,
                    h.weighted_as * 1e3,
                    h.rejected,
                    data.frames(b).len()
                );
            }
        }
        let folds = heldout::by_repeat(&rec);
        let t3 = Instant::now();
        if !found.slots.is_empty() {
            let a = heldout::Score::of(&data, &found.best, &folds).unwrap();
            for s in &found.slots {
                let b = heldout::Score::of(&data, &s.without, &folds).unwrap();
                let (g, se) = a.gain_over(&b);
                println!(
                    "   heldout gain {g:.1} +- {se:.1} = {:.1} SE; rms {:.2} -> {:.2} um inside {:?} {:?} {:?}",
                    g / se,
                    b.rms * 1e6,
                    a.rms * 1e6,
                    b.inside,
                    a.inside,
                    t3.elapsed()
                );
            }
        }
    }
}
