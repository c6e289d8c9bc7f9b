//! quick
use inference::stream;
use inference::*;
#[test]
fn quick() {
    let ring = twin::Ring::booster();
    let only = std::env::var("REC").ok();
    for rec in [
        "recordings/paper-vars",
        "recordings/random-vars",
        "../shared/recordings/booster/drift-stream",
        "../shared/recordings/concealed/open-00",
        "../shared/recordings/concealed/open-07",
        "../shared/recordings/concealed/open-06",
    ] {
        if let Some(o) = &only {
            if !rec.contains(o.as_str()) {
                continue;
            }
        }
        let path = system_tests::repository(rec);
        let r = Recording::read(&path, &stream::layout(&ring)).unwrap();
        let truth: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(path.join("truth.json")).unwrap()).unwrap();
        let q: f32 = std::env::var("Q").ok().map_or(0.0, |q| q.parse().unwrap());
        let mut core = stream::estimator(&ring, &r, q).unwrap();
        let mut times = vec![];
        let mut lin = 0;
        let mut last = None;
        let mut rej = 0;
        for row in &r.rows {
            if std::env::var("NORF").is_ok() && row.rf_offset != 0.0 {
                continue;
            }
            let mut b = stream::wire(&r, row).unwrap();
            let t = std::time::Instant::now();
            let e = core.ingest(&mut b).unwrap();
            times.push((t.elapsed().as_secs_f64() * 1e6, e.linearised));
            lin += e.linearised as u32;
            rej += e.rejected.count_ones();
            last = Some(e);
        }
        let e = last.unwrap();
        let names = ring.var_names();
        let mut s = [0.0; 2];
        let mut sg = [0.0; 2];
        let mut d = nalgebra::DVector::zeros(48);
        for i in 0..48 {
            let t = truth["vars"][&names[i]].as_f64().unwrap();
            d[i] = e.map_params[i] as f64 - t.ln();
            s[i / 24] += (e.mean[i] as f64 - t).powi(2) / 24.0;
            sg[i / 24] += e.sigma[i] as f64 / 24.0;
        }
        let p = nalgebra::DMatrix::from_fn(48, 48, |i, j| core.covariance(i, j) as f64);
        let nees = (d.transpose() * p.try_inverse().unwrap() * &d)[0] / 48.0;
        let f = core.fit_quality();
        if q == 0.0 && std::env::var("FIT").is_ok() {
            let t0 = std::time::Instant::now();
            match BatchFit::of(&ring, &r, |_| ()) {
                Err(e) => println!("   fit: {e}"),
                Ok(fit) => {
                    let shift = (0..48)
                        .map(|i| ((fit.map_params[i] - e.map_params[i] as f64) / fit.covariance[(i, i)].sqrt()).abs())
                        .fold(0.0, f64::max);
                    let ratio = (0..48)
                        .map(|i| (e.params_sigma[i] as f64 / fit.covariance[(i, i)].sqrt() - 1.0).abs())
                        .fold(0.0, f64::max);
                    println!(
                        "   fit: shift {shift:.3} sigma, ratio off {ratio:.4}, chi2 {:.4}, steps {}, tunes {:?} {:?}",
                        fit.chi2_per_dof,
                        fit.steps,
                        fit.tunes,
                        t0.elapsed()
                    );
                }
            }
        }
        let mut lt: Vec<f64> = times.iter().filter(|t| t.1).map(|t| t.0).collect();
        lt.sort_by(f64::total_cmp);
        let mut t: Vec<f64> = times.iter().map(|t| t.0).collect();
        t.sort_by(f64::total_cmp);
        println!(
            "{rec}: rms {:.3}% {:.3}% sigma {:.3}% {:.3}% nees {:.2} chi2 {:.4} lin {lin} rej {rej} ev {:.1} p50 {:.1} p99 {:.1} max {:.1} lin-med {:.1} clipped {:b}",
            100.0 * s[0].sqrt(),
            100.0 * s[1].sqrt(),
            100.0 * sg[0],
            100.0 * sg[1],
            nees,
            f.chi_square / f.degrees_of_freedom,
            e.log_evidence,
            t[t.len() / 2],
            t[t.len() * 99 / 100],
            t[t.len() - 1],
            lt[lt.len() / 2],
            e.clipped
        );
        for (n, h) in ring.monitor_names().iter().zip(&e.health) {
            if h.state != estimator::MonitorState::Ok || h.sigma != 1.5e-4 {
                println!("   {n} {:?} {:.3} mm rej {}", h.state, h.sigma * 1e3, h.rejected)
            }
        }
    }
    println!("size {}", std::mem::size_of::<Booster>());
}
#[test]
fn when() {
    let ring = twin::Ring::booster();
    let r = Recording::read(&system_tests::repository("recordings/paper-vars"), &stream::layout(&ring)).unwrap();
    let mut core = stream::estimator(&ring, &r, 0.0).unwrap();
    let mut prev: Option<Vec<f32>> = None;
    for row in &r.rows {
        let mut b = stream::wire(&r, row).unwrap();
        let e = core.ingest(&mut b).unwrap();
        let moved = prev.as_ref().map_or(0.0, |p| {
            p.iter()
                .zip(&e.map_params)
                .zip(&e.params_sigma)
                .map(|((a, b), s)| ((a - b) / s).abs())
                .fold(0.0f32, f32::max)
        });
        if e.linearised {
            print!(
                "{}({:.2}{}{}) ",
                e.sequence,
                moved,
                if e.confirmed != 0 { "c" } else { "" },
                if e.restarted != 0 { "r" } else { "" }
            );
        }
        prev = Some(e.map_params.to_vec());
    }
    println!();
}
#[test]
fn micro() {
    use estimator::*;
    let ring = twin::Ring::booster();
    let g: training::BoosterGreen = training::green::tables(&ring).unwrap();
    let mut lin = Default::default();
    let time = |name: &str, n: u32, f: &mut dyn FnMut()| {
        let t = std::time::Instant::now();
        for _ in 0..n {
            f()
        }
        println!("{name} {:.2} us", t.elapsed().as_secs_f64() * 1e6 / n as f64);
    };
    let st: [f32; 48] = core::array::from_fn(|i| 1.0 + 0.01 * ((i as f32) * 1.7).sin());
    time("linearise", 200, &mut || Surrogate::<33, 48, 48>::linearise(&g, &st, &mut lin).unwrap());
    let mut p = Prediction::<33, 48>::default();
    let mut d = Drive { kick: [1e-7; 48], strength: [1e-4; 2], rf_offset: 0.0 };
    d.kick[5] = 2e-4;
    time("predict", 2000, &mut || g.predict(&lin, &d, &mut p));
    let prior = Prior::lognormal(0.03);
    let mut ga = Gaussian::<33, 48>::prior(&prior);
    time("condition x33", 2000, &mut || {
        for b in 0..33 {
            ga.condition(b, 1e-3, 2e-8, &p.jacobian.as_slice()[b * 48..(b + 1) * 48])
        }
    });
    let mut s = Solution::default();
    time("solve", 2000, &mut || {
        s.solve(&ga, &prior);
    });
    let r = Recording::read(&system_tests::repository("recordings/paper-vars"), &stream::layout(&ring)).unwrap();
    let w = stream::wire(&r, &r.rows[9]).unwrap();
    time("decode", 2000, &mut || {
        let mut b = w.clone();
        std::hint::black_box(Frame::<33, 48>::decode(&mut b).unwrap());
    });
    println!("wire bytes {}", w.len());
}
