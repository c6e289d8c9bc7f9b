#![allow(missing_docs, clippy::all)]
use inference::diagnose::{data::Data, fit::Fitted, hypothesis::Hypothesis, scan};
use inference::{
    Recording,
    prove::{Case, Class},
    simulate, stream,
};
fn show(name: &str, ring: &twin::Ring, data: &Data, vars: &[f64], given: Vec<twin::Effect>) {
    let hyp = Hypothesis { given, ..Default::default() };
    let ln: Vec<f64> = vars.iter().map(|v| v.ln()).collect();
    let (m, d) = hyp.machine(data, &ln, &[]).unwrap();
    let (r, t, td) = m.readings(&d).unwrap();
    let res = data.residual(&r, t, td);
    let n = res.len();
    let f = Fitted::of(data, &hyp, &nalgebra::DVector::zeros(48)).unwrap();
    println!(
        "{name}: at truth chi2 {:.4} tunes z {:.2} {:.2} drift {:.2} {:.2}; fit cost/n {:.4} tunes z {:.2} {:.2} (sigma 3e-4) baseline {:.1} {:.1} mm q {:.3} {:.3}",
        res.norm_squared() / n as f64,
        res[n - 4],
        res[n - 2],
        res[n - 3],
        res[n - 1],
        f.residual.norm_squared() / n as f64,
        f.residual[n - 4],
        f.residual[n - 2],
        data.baseline_rms[0] * 1e3,
        data.baseline_rms[1] * 1e3,
        t.x,
        t.y
    );
    let _ = ring;
}
fn main() {
    let ring = twin::Ring::booster();
    let lay = stream::layout(&ring);
    for i in 0..12 {
        let name = format!("/work/shared/recordings/concealed/open-{i:02}");
        let rec = Recording::read(std::path::Path::new(&name), &lay).unwrap();
        let key = inference::score::Truth::read(std::path::Path::new(&name)).unwrap();
        let data = Data::of(&ring, &rec).unwrap();
        let vars: Vec<f64> = ring.var_names().iter().map(|n| key.vars[n]).collect();
        let given = key
            .effects
            .iter()
            .map(|e| {
                let s = format!(
                    "{}{}{}={}",
                    e.kind,
                    if e.at.is_empty() { "" } else { "@" },
                    e.at,
                    e.amplitude.unwrap_or(1.0)
                );
                s.parse().unwrap()
            })
            .collect();
        show(&name[30..], &ring, &data, &vars, given);
    }
    let rec = Recording::read(std::path::Path::new("recordings/paper-vars"), &lay).unwrap();
    let d0 = Data::of(&ring, &rec).unwrap();
    let terms = scan::candidates(&d0, rec.header.radial_loop_monitors.as_ref());
    for i in 0..14 {
        let case = Case::draw(&ring, &rec, &terms, Class::Empty, i, 1);
        let hw = simulate::Hardware::shipped(&ring, &rec);
        let truth = simulate::Truth { vars: &case.vars, effects: &case.effects, beyond: &[] };
        let r = simulate::campaign(&rec, &ring, &truth, &hw, case.seed).unwrap();
        let data = Data::of(&ring, &r).unwrap();
        show(&format!("sim {i}"), &ring, &data, &case.vars, vec![]);
    }
}
