//! Correlations of the vars: of one with all others, of all with all, and whether they come from the machine or the method.

use inference::simulate::{self, Instruments};
use inference::{Readings, TuneUse};
use report::{Axes, Figure, Reference, Section, Series};

use super::sampled::largest_difference;
use super::sampling::{self, Sampling};
use super::{Sampled, StudyError};

/// An open question of the published analysis: the same with the readings replaced by simulation at the point estimate.
pub fn study(sampling: &mut Sampling, reference: &Sampled, var: usize) -> Result<Section, StudyError> {
    let simulated = simulated(sampling, reference)?;
    let names = sampling.names();
    let (measured, made) = (reference.correlation(), simulated.correlation());
    // along the ring, where the oscillation shows
    let mut along: Vec<usize> = (0..names.len()).collect();
    let ring = &sampling.campaign().ring;
    along.sort_by_key(|&j| ring.quadrupoles[ring.parameters[j].quadrupoles[0]].element);
    let ring_names: Vec<String> = along.iter().map(|&j| names[j].clone()).collect();
    let row = |label: &str, matrix: &nalgebra::DMatrix<f64>| {
        let y = along.iter().map(|&j| if j == var { f64::NAN } else { matrix[(var, j)] });
        Series::points(label, (0..names.len()).map(|j| j as f64).collect(), y.collect())
    };
    let title = format!("Correlation of {} with every other var", names[var]);
    let axes = Axes::new(&title, "quadrupole, along the ring", "correlation [1]")
        .named(&ring_names)
        .compared(Reference::Level(0.0));
    let alike = likeness(&measured, &made);
    let verdict = if alike > 0.9 {
        "The pattern comes from the method: readings simulated by the twin show it too. Posterior covariances follow from how responses depend on \
         neighbouring quadrupoles, from the settings and from the weights, and hardly from the readings themselves, so that this \
         pattern is no evidence for or against errors of the machine."
    } else {
        "The two differ by more than that: few draws, or readings that count in one and not in the other."
    };
    Ok(Section {
        heading: "Correlations".into(),
        text: vec![format!(
            "Posterior correlations of all frames, and the same after every reading was replaced by a simulated one: the twin at the \
             posterior mean, the same settings and read-backs, fresh noise. Entries off the diagonal correlate with {alike:.3} between the two; the \
             largest difference is {:.2}, of which {:.2} is the sampler's own (three Monte Carlo errors). {verdict}",
            largest_difference(&measured, &made),
            3.0 * (2.0 / reference.smallest_ess()).sqrt()
        )],
        figures: vec![
            (
                format!("Correlation of {} with every other var, recorded and simulated.", names[var]),
                Figure::lines(&axes, &[row("recorded", &measured), row("simulated at the point estimate", &made)]),
            ),
            (
                "Correlations of all vars, recorded.".into(),
                Figure::heat_map("Correlations, recorded", "correlation [1]", &names, &measured),
            ),
            (
                "The same with simulated readings.".into(),
                Figure::heat_map("Correlations, simulated at the point estimate", "correlation [1]", &names, &made),
            ),
        ],
        ..Section::default()
    })
}

fn simulated(sampling: &mut Sampling, reference: &Sampled) -> Result<Sampled, StudyError> {
    let seed = sampling.seed();
    let campaign = sampling.campaign();
    let noise = (0..campaign.monitors()).map(|b| campaign.noise(b)).collect();
    let instruments = Instruments { noise, ..Instruments::healthy(&campaign.ring, &campaign.recording)? };
    let made = simulate::like(&campaign.recording, &campaign.ring, &reference.mean(), &instruments, seed)?;
    let reduced = sampling::reduced(&campaign.ring, &made)?;
    let readings = Readings::of_frames(&reduced, &sampling.twin, TuneUse::LeftOut);
    sampling.sample("simulated at the point estimate", readings, None)
}

/// Correlation coefficient of the entries off the diagonals of two matrices.
fn likeness(one: &nalgebra::DMatrix<f64>, other: &nalgebra::DMatrix<f64>) -> f64 {
    let off = |m: &nalgebra::DMatrix<f64>| -> Vec<f64> {
        (0..m.nrows()).flat_map(|i| (0..i).map(move |j| (i, j))).map(|at| m[at]).collect()
    };
    let (a, b) = (off(one), off(other));
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (ma, mb) = (mean(&a), mean(&b));
    let sum = |f: &dyn Fn(f64, f64) -> f64| a.iter().zip(&b).map(|(x, y)| f(x - ma, y - mb)).sum::<f64>();
    sum(&|x, y| x * y) / (sum(&|x, _| x * x) * sum(&|_, y| y * y)).sqrt()
}
