#![allow(missing_docs, clippy::all)]
use inference::diagnose::{data::Data, fit::Fitted, hypothesis::{Hypothesis, Term}, scan};
use inference::{Recording, stream, prove::{Case, Class}, simulate};
fn main() {
    let ring = twin::Ring::booster();
    let rec = Recording::read(std::path::Path::new("recordings/paper-vars"), &stream::layout(&ring)).unwrap();
    let d0 = Data::of(&ring, &rec).unwrap();
    let terms = scan::candidates(&d0, rec.header.radial_loop_monitors.as_ref());
    for i in 0..18 {
        let case = Case::draw(&ring, &rec, &terms, Class::Single, 1_000_000 + i, 1);
        if case.effects[0].kind != twin::EffectKind::DipoleEdge && case.effects[0].kind != twin::EffectKind::StrayGradient  { continue; }
        let hw = simulate::Hardware::shipped(&ring, &rec);
        let truth = simulate::Truth { vars: &case.vars, effects: &case.effects, beyond: &[] };
        let r = simulate::campaign(&rec, &ring, &truth, &hw, case.seed).unwrap();
        let data = Data::of(&ring, &r).unwrap();
        let zero = nalgebra::DVector::zeros(48);
        let f0 = Fitted::of(&data, &Hypothesis::default(), &zero).unwrap();
        let fg = Fitted::of(&data, &Hypothesis { given: case.effects.clone(), ..Default::default() }, &zero).unwrap();
        let ft = Fitted::of(&data, &Hypothesis::default().with(Term::new(case.effects[0].kind, &case.effects[0].place)), &f0.u).unwrap();
        let tz = Fitted::of(&data, &Hypothesis::default().with(Term::new(case.effects[0].kind, &case.effects[0].place)), &zero).unwrap();
        println!("{:?} null {} given {} term {} {:?} term from zero {} {:?} ev {} {}", case.effects[0], f0.cost, fg.cost, ft.cost, ft.amplitude(&data, 0), tz.cost, tz.amplitude(&data,0), f0.log_evidence, ft.log_evidence);
        let th: Vec<f64> = case.vars.iter().map(|v| (v.ln() - inference::diagnose::fit::prior().0)/inference::diagnose::fit::prior().1).collect();
        let at = nalgebra::DVector::from_vec(th);
        println!("   |u| null {} given {} term {} truth {}; umax null {}", f0.u.norm_squared(), fg.u.norm_squared(), ft.u.rows(0,48).norm_squared(), at.norm_squared(), f0.u.amax());
        let n = f0.residual.len(); println!("   tune residuals null {:?} given {:?} term {:?}", f0.residual.rows(n-4,4).transpose(), fg.residual.rows(n-4,4).transpose(), ft.residual.rows(n-4,4).transpose());
    }
}
