//! Stability: differences of single frame pairs, drawn several times, and all of them pooled.

use inference::{Campaign, quantile};
use inference::{Pair, Readings};
use nalgebra::DMatrix;
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use report::{Axes, Band, Figure, Reference, Section, Table};
use schemars::JsonSchema;
use serde::Serialize;

use super::sampling::Sampling;
use super::settings::{Kind, Settings};
use super::{Sampled, StudyError, SubsetNumbers, VarNumbers};

/// One frame pair for each corrector that has both settings.
#[derive(Debug, Clone)]
pub struct Subset {
    /// Which settings.
    pub kind: Kind,
    /// The pairs.
    pub pairs: Vec<Pair>,
}

/// Each kind, and how often it is drawn, as in the published analysis.
const DRAWN: [(Kind, usize); 4] =
    [(Kind::ZeroToEither, 8), (Kind::ZeroToPlus, 4), (Kind::ZeroToMinus, 4), (Kind::MinusToPlus, 4)];

/// Standard deviations of the vars in one kind of subset.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct Widths {
    /// The settings.
    pub kind: String,
    /// Each var: name, median over the subsets, of the pooled draws.
    pub vars: Vec<Width>,
}

/// Standard deviation of one var.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct Width {
    /// Its name.
    pub name: String,
    /// Median over the subsets.
    pub median: f64,
    /// Of the draws of all subsets together.
    pub pooled: f64,
}

/// All subsets with their posteriors.
pub struct Subsets {
    pub(crate) all: Vec<(Subset, Sampled)>,
    /// What the settings are called.
    pub(crate) settings: Settings,
}

impl Subset {
    /// Draw a pair for each corrector at random among its repeats.
    pub fn draw(campaign: &Campaign, kind: Kind, seed: u64) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        let (rows, correctors) = (&campaign.recording.rows, campaign.ring.correctors.len());
        let settings = Settings::of(&campaign.recording, correctors);
        let (initial, finals) = kind.signs();
        let mut pairs = Vec::new();
        for corrector in 0..correctors {
            let at = |signs: &[f64]| settings.frames(rows, corrector, signs);
            if let (Some(&initial), Some(&last)) = (at(&[initial]).choose(&mut random), at(finals).choose(&mut random))
            {
                pairs.push(Pair { initial, last });
            }
        }
        Self { kind, pairs }
    }
}

/// Kinds of which a campaign has pairs, and how often each is drawn.
pub fn drawn(campaign: &Campaign) -> Vec<(Kind, usize)> {
    DRAWN.into_iter().filter(|(kind, _)| !Subset::draw(campaign, *kind, 0).pairs.is_empty()).collect()
}

/// Sample every subset of some kinds, each this often, by a model whose error in a difference is `error`, by monitor [m].
///
/// # Errors
/// [`StudyError`].
pub fn sample(
    sampling: &mut Sampling,
    drawn: &[(Kind, usize)],
    error: impl Fn(usize) -> f64,
) -> Result<Subsets, StudyError> {
    let campaign = sampling.campaign();
    let settings = Settings::of(&campaign.recording, campaign.ring.correctors.len());
    let mut all = Vec::new();
    for (kind, times) in drawn {
        for i in 1..=*times {
            let seed = sampling.seed();
            let subset = Subset::draw(sampling.campaign(), *kind, seed);
            let readings = Readings::of_pairs(&sampling.reduced, &error, &subset.pairs);
            let name = format!("{}, subset {i}", settings.words(*kind));
            let sampled = sampling.sample(&name, readings, None)?;
            all.push((subset, sampled));
        }
    }
    Ok(Subsets { all, settings })
}

impl Subsets {
    fn of(&self, kind: Kind) -> impl Iterator<Item = &Sampled> + Clone {
        self.all.iter().filter(move |(subset, _)| subset.kind == kind).map(|(_, sampled)| sampled)
    }

    /// The kinds that were drawn.
    fn kinds(&self) -> Vec<Kind> {
        let mut kinds: Vec<Kind> = self.all.iter().map(|(subset, _)| subset.kind).collect();
        kinds.dedup();
        kinds
    }

    /// The kind with the largest kicks, which says most.
    pub fn widest(&self) -> Option<Kind> {
        let order = [Kind::MinusToPlus, Kind::ZeroToPlus, Kind::ZeroToMinus, Kind::ZeroToEither];
        order.into_iter().find(|kind| self.kinds().contains(kind))
    }

    /// The first subset of the widest kind.
    pub fn first(&self) -> Option<&(Subset, Sampled)> {
        let widest = self.widest()?;
        self.all.iter().find(|(subset, _)| subset.kind == widest)
    }

    /// What a kind is called.
    pub fn words(&self, kind: Kind) -> String {
        self.settings.words(kind)
    }

    /// Draws of all subsets of a kind together.
    fn pooled(&self, kind: Kind) -> DMatrix<f64> {
        let rows: Vec<_> = self.of(kind).flat_map(|s| s.vars.row_iter()).collect();
        DMatrix::from_rows(&rows)
    }

    /// Every subset.
    pub fn numbers(&self) -> Vec<SubsetNumbers> {
        let one = |(subset, sampled): &(Subset, Sampled)| SubsetNumbers {
            kind: self.words(subset.kind),
            pairs: subset.pairs.len(),
            vars: sampled.summary.iter().map(VarNumbers::of).collect(),
        };
        self.all.iter().map(one).collect()
    }

    /// Standard deviations by kind.
    pub(crate) fn widths(&self, names: &[String]) -> Vec<Widths> {
        let of_kind = |kind: Kind| {
            let pooled = self.pooled(kind);
            let each: Vec<Vec<f64>> = self.of(kind).map(Sampled::sigma).collect();
            let width = |(i, name): (usize, &String)| {
                let median = quantile(&sorted(each.iter().map(|sigma| sigma[i])), 0.5);
                Width { name: name.clone(), median, pooled: pooled.column(i).variance().sqrt() }
            };
            Widths { kind: self.words(kind), vars: names.iter().enumerate().map(width).collect() }
        };
        self.kinds().into_iter().map(of_kind).collect()
    }

    /// How the subsets differ from each other.
    pub fn stability(&self, names: &[String]) -> Section {
        let figure = |kind: Kind| {
            let words = self.words(kind);
            let title = format!("{} subsets {words}: bars 68 %, lines 95 %", self.of(kind).count());
            let axes = Axes::new(&title, "quadrupole", "var [1]").named(names).compared(Reference::Level(1.0));
            let bands: Vec<Band> = self.of(kind).zip(1..).map(|(s, i)| s.band(&format!("subset {i}"))).collect();
            // five groups fit beside each other
            let drawn = bands.len().min(5);
            (
                format!("Posterior of each var from single differences {words}, {drawn} of {} subsets.", bands.len()),
                Figure::bands(&axes, &bands[..drawn]),
            )
        };
        let counts: Vec<String> =
            self.kinds().iter().map(|kind| format!("{} of {}", self.of(*kind).count(), self.words(*kind))).collect();
        Section {
            heading: "Stability over subsets of the data".into(),
            text: vec![format!(
                "Each subset takes one initial and one final frame per corrector at random among the repeats: {}. {}",
                counts.join(", "),
                self.scatter(names)
            )],
            figures: self.kinds().into_iter().map(figure).collect(),
            tables: vec![self.width_table(names)],
        }
    }

    /// Scatter of the subsets over their stated widths.
    fn scatter(&self, names: &[String]) -> String {
        let scatter = |kind: Kind| {
            let each: Vec<&Sampled> = self.of(kind).collect();
            let of_var = |i: usize| {
                let means: Vec<f64> = each.iter().map(|s| s.summary[i].mean).collect();
                let mean = means.iter().sum::<f64>() / means.len() as f64;
                let variance = means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / (means.len() as f64 - 1.0);
                variance / (each.iter().map(|s| s.summary[i].sd.powi(2)).sum::<f64>() / each.len() as f64)
            };
            let ratio = (0..names.len()).map(of_var).sum::<f64>() / names.len() as f64;
            format!("{:.2} for {}", ratio.sqrt(), self.words(kind))
        };
        format!(
            "The rms scatter of the means between subsets, over the width that each states: {}. Subsets share \
             the prior and, repeats being few, some frames: independent ones would scatter by 1.",
            self.kinds().into_iter().map(scatter).collect::<Vec<_>>().join(", ")
        )
    }

    fn width_table(&self, names: &[String]) -> Table {
        let widths = self.widths(names);
        let cell = |w: &Width| format!("{:.2} / {:.2}", 100.0 * w.median, 100.0 * w.pooled);
        let row = |(i, name): (usize, &String)| {
            core::iter::once(name.clone()).chain(widths.iter().map(|kind| cell(&kind.vars[i]))).collect()
        };
        Table {
            caption: "Standard deviation of each var [%]: of one subset (median over the subsets) / of all pooled."
                .into(),
            header: core::iter::once("var".to_owned()).chain(widths.iter().map(|w| w.kind.clone())).collect(),
            rows: names.iter().enumerate().map(row).collect(),
        }
    }

    /// Pooled posterior of the widest kind: its band, and each var in the notation of [`notation`].
    pub fn pooled_band(&self) -> Option<(Band, Vec<String>)> {
        let kind = self.widest()?;
        let pooled = self.pooled(kind);
        let columns: Vec<Vec<f64>> = pooled.column_iter().map(|column| sorted(column.iter().copied())).collect();
        let at = |i: usize, p: f64| quantile(&columns[i], p);
        let mean: Vec<f64> = pooled.row_mean().iter().copied().collect();
        let each = 0..columns.len();
        let words = each.clone().map(|i| notation(mean[i], [at(i, 0.025), at(i, 0.16), at(i, 0.84), at(i, 0.975)]));
        let band = Band {
            label: format!("{}, {} subsets pooled", self.words(kind), self.of(kind).count()),
            inner: each.clone().map(|i| (at(i, 0.16), at(i, 0.84))).collect(),
            outer: each.clone().map(|i| (at(i, 0.025), at(i, 0.975))).collect(),
            centre: mean.clone(),
        };
        Some((band, words.collect()))
    }

    /// Half width of the 68 % band of each var: the median over the subsets of a kind.
    pub fn half_widths(&self, kind: Kind) -> Vec<f64> {
        let vars = self.all.first().map_or(0, |(_, sampled)| sampled.summary.len());
        let half = |i: usize| self.of(kind).map(move |s| (s.summary[i].q84 - s.summary[i].q16) / 2.0);
        (0..vars).map(|i| quantile(&sorted(half(i)), 0.5)).collect()
    }
}

/// The vars from all frames, beside the pooled subsets if there are any.
pub fn final_table(sampling: &Sampling, subsets: &Subsets, reference: &Sampled) -> Section {
    let (names, pooled) = (sampling.names(), subsets.pooled_band());
    let row = |(i, name): (usize, &String)| {
        let s = &reference.summary[i];
        let pooled = pooled.iter().map(|(_, words)| words[i].clone());
        let all = notation(s.mean, [s.q025, s.q16, s.q84, s.q975]);
        core::iter::once(name.clone()).chain(pooled).chain([all]).collect()
    };
    let header = pooled.iter().map(|(band, _)| band.label.clone());
    let header = core::iter::once("var".to_owned()).chain(header).chain(["all frames".to_owned()]);
    let axes = Axes::new("Strength of each quadrupole over its design: bars 68 %, lines 95 %", "quadrupole", "var [1]");
    let axes = axes.named(&names).compared(Reference::Level(1.0));
    let bands: Vec<Band> = pooled.iter().map(|(band, _)| band.clone()).chain([reference.band("all frames")]).collect();
    Section {
        heading: "The quadrupoles' strengths".into(),
        text: vec!["Strength factor (var) of every quadrupole: mean, and in brackets the distances of the 68 % and of the 95 % band."
            .into()],
        figures: vec![("Posterior of every var.".into(), Figure::bands(&axes, &bands))],
        tables: vec![Table {
            caption: "Final table.".into(),
            header: header.collect(),
            rows: names.iter().enumerate().map(row).collect(),
        }],
    }
}

/// Mean with the distances of the 68 % and the 95 % band.
fn notation(mean: f64, [q025, q16, q84, q975]: [f64; 4]) -> String {
    let mm = |q: f64| format!("{:+.4}", q - mean);
    format!("{mean:.4} ({} {}) ({} {})", mm(q16), mm(q84), mm(q025), mm(q975))
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}
