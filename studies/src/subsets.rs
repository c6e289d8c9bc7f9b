//! Stability: the paper's differences of single frame pairs, drawn anew several times, and all of them pooled.

use nalgebra::DMatrix;
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use serde::Serialize;

use super::{Bench, Sampled, StudyError, SubsetNumbers, VarNumbers, WIDTH};
use inference::readings::{Campaign, Pair, Readings};
use report::{Axes, Band, Figure, Reference, Section, Table};

/// Which settings a difference is taken between.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// From 0 to +22 A or -22 A, whichever chance takes.
    ZeroToEither,
    /// From 0 to +22 A.
    ZeroToPlus,
    /// From 0 to -22 A.
    ZeroToMinus,
    /// From -22 A to +22 A.
    MinusToPlus,
}

/// One frame pair for each corrector that has both settings.
#[derive(Debug, Clone)]
pub struct Subset {
    /// Which settings.
    pub kind: Kind,
    /// The pairs.
    pub pairs: Vec<Pair>,
}

/// Each kind, and how often it is drawn, as in the paper.
const DRAWN: [(Kind, usize); 4] =
    [(Kind::ZeroToEither, 8), (Kind::ZeroToPlus, 4), (Kind::ZeroToMinus, 4), (Kind::MinusToPlus, 4)];

/// Standard deviations of the vars in one kind of subset.
#[derive(Debug, Clone, Serialize)]
pub struct Widths {
    /// The settings.
    pub kind: &'static str,
    /// Each var: name, median over the subsets, of the pooled draws.
    pub vars: Vec<Width>,
}

/// Standard deviation of one var.
#[derive(Debug, Clone, Serialize)]
pub struct Width {
    /// Its name.
    pub name: String,
    /// Median over the subsets.
    pub median: f64,
    /// Of the draws of all subsets together.
    pub pooled: f64,
}

/// All subsets with their posteriors.
pub struct Subsets(pub Vec<(Subset, Sampled)>);

impl Kind {
    /// In words.
    pub fn word(self) -> &'static str {
        match self {
            Self::ZeroToEither => "0 -> +-22 A",
            Self::ZeroToPlus => "0 -> +22 A",
            Self::ZeroToMinus => "0 -> -22 A",
            Self::MinusToPlus => "-22 -> +22 A",
        }
    }

    /// Sign of the initial setting, and those that the final one may have.
    fn signs(self) -> (f64, &'static [f64]) {
        match self {
            Self::ZeroToEither => (0.0, &[1.0, -1.0]),
            Self::ZeroToPlus => (0.0, &[1.0]),
            Self::ZeroToMinus => (0.0, &[-1.0]),
            Self::MinusToPlus => (-1.0, &[1.0]),
        }
    }
}

impl Subset {
    /// Draw a pair for each corrector at random among its repeats.
    pub fn draw(campaign: &Campaign, kind: Kind, seed: u64) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        let rows = &campaign.recording.rows;
        let (initial, finals) = kind.signs();
        let sign = |setting: f64| if setting == 0.0 { 0.0 } else { setting.signum() };
        let mut pairs = Vec::new();
        for corrector in campaign.ring.labels(campaign.ring.correctors.iter().map(|c| c.element)) {
            // of several amplitudes the largest
            let own = rows.iter().filter(|row| row.corrector.as_ref() == Some(&corrector));
            let largest = own.map(|row| row.setting.abs()).fold(0.0, f64::max);
            let at = |signs: &[f64]| -> Vec<usize> {
                let own = |(_, row): &(usize, &inference::recording::Row)| {
                    row.corrector.as_ref() == Some(&corrector)
                        && row.rf_offset == 0.0
                        && signs.contains(&sign(row.setting))
                        && (row.setting == 0.0 || row.setting.abs() > 0.9 * largest)
                };
                rows.iter().enumerate().filter(own).map(|(i, _)| i).collect()
            };
            if let (Some(&initial), Some(&last)) = (at(&[initial]).choose(&mut random), at(finals).choose(&mut random))
            {
                pairs.push(Pair { initial, last });
            }
        }
        Self { kind, pairs }
    }
}

/// Sample every subset.
pub fn study(bench: &mut Bench) -> Result<(Section, Subsets), StudyError> {
    let mut all = Vec::new();
    for (kind, times) in DRAWN {
        for i in 1..=times {
            let seed = bench.seed();
            let subset = Subset::draw(&bench.campaign, kind, seed);
            if subset.pairs.is_empty() {
                let recording = bench.campaign.recording.name.clone();
                return Err(StudyError::NoPairs { recording, kind: kind.word() });
            }
            let readings = Readings::of_pairs(&bench.campaign, &bench.twin, &subset.pairs);
            let sampled = bench.sample(&format!("{}, subset {i}", kind.word()), readings, WIDTH)?;
            all.push((subset, sampled));
        }
    }
    let subsets = Subsets(all);
    Ok((subsets.section(&bench.names()), subsets))
}

impl Subsets {
    fn of(&self, kind: Kind) -> impl Iterator<Item = &Sampled> + Clone {
        self.0.iter().filter(move |(subset, _)| subset.kind == kind).map(|(_, sampled)| sampled)
    }

    /// The first subset of a kind.
    pub fn first(&self, kind: Kind) -> Option<&(Subset, Sampled)> {
        self.0.iter().find(|(subset, _)| subset.kind == kind)
    }

    /// Draws of all subsets of a kind together.
    fn pooled(&self, kind: Kind) -> DMatrix<f64> {
        let rows: Vec<_> = self.of(kind).flat_map(|s| s.vars.row_iter()).collect();
        DMatrix::from_rows(&rows)
    }

    /// Every subset.
    pub fn numbers(&self) -> Vec<SubsetNumbers> {
        let one = |(subset, sampled): &(Subset, Sampled)| SubsetNumbers {
            kind: subset.kind.word(),
            pairs: subset.pairs.len(),
            vars: sampled.summary.iter().map(VarNumbers::of).collect(),
        };
        self.0.iter().map(one).collect()
    }

    /// Standard deviations by kind.
    pub fn widths(&self, names: &[String]) -> Vec<Widths> {
        let of_kind = |(kind, _): (Kind, usize)| {
            let pooled = self.pooled(kind);
            let each: Vec<Vec<f64>> = self.of(kind).map(Sampled::sigma).collect();
            let width = |(i, name): (usize, &String)| {
                let mut own: Vec<f64> = each.iter().map(|sigma| sigma[i]).collect();
                Width { name: name.clone(), median: median(&mut own), pooled: pooled.column(i).variance().sqrt() }
            };
            Widths { kind: kind.word(), vars: names.iter().enumerate().map(width).collect() }
        };
        DRAWN.map(of_kind).to_vec()
    }

    fn section(&self, names: &[String]) -> Section {
        let figure = |(kind, times): (Kind, usize)| {
            let title = format!("{} subsets {}: bars 68 %, lines 95 %", times, kind.word());
            let axes = Axes::new(&title, "quadrupole", "var [1]").named(names).compared(Reference::Level(1.0));
            let bands: Vec<Band> = self.of(kind).zip(1..).map(|(s, i)| s.band(&format!("subset {i}"))).collect();
            // five groups fit beside each other
            (
                format!("Posterior of each var from single differences {}.", kind.word()),
                Figure::bands(&axes, &bands[..bands.len().min(5)]),
            )
        };
        Section {
            heading: "Stability over subsets of the data".into(),
            text: vec![format!(
                "Each subset takes one initial and one final frame per corrector at random among the repeats: eight of 0 to ±22 A \
                 (five are drawn in the figure), four each of 0 to +22 A, 0 to -22 A and -22 to +22 A. {}",
                self.verdict(names)
            )],
            figures: DRAWN.map(figure).to_vec(),
            tables: vec![self.width_table(names)],
        }
    }

    /// How the subsets differ beside what their own widths allow.
    fn verdict(&self, names: &[String]) -> String {
        let scatter = |(kind, _): (Kind, usize)| {
            let each: Vec<&Sampled> = self.of(kind).collect();
            let of_var = |i: usize| {
                let means: Vec<f64> = each.iter().map(|s| s.summary[i].mean).collect();
                let mean = means.iter().sum::<f64>() / means.len() as f64;
                let variance = means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / (means.len() as f64 - 1.0);
                variance / (each.iter().map(|s| s.summary[i].sd.powi(2)).sum::<f64>() / each.len() as f64)
            };
            let ratio = (0..names.len()).map(of_var).sum::<f64>() / names.len() as f64;
            format!("{:.2} for {}", ratio.sqrt(), kind.word())
        };
        format!(
            "The rms scatter of the means between subsets, over the width that each states: {}. Subsets share \
             the prior and, repeats being few, some frames: independent ones would scatter by 1.",
            DRAWN.map(scatter).join(", ")
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
            header: core::iter::once("var".to_owned()).chain(widths.iter().map(|w| w.kind.to_owned())).collect(),
            rows: names.iter().enumerate().map(row).collect(),
        }
    }

    /// The pooled result beside all frames and the published values.
    pub fn final_table(&self, bench: &Bench, reference: &Sampled) -> Section {
        let names = bench.names();
        let pooled = self.pooled(Kind::MinusToPlus);
        let mut columns: Vec<Vec<f64>> = (0..names.len()).map(|i| pooled.column(i).iter().copied().collect()).collect();
        columns.iter_mut().for_each(|column| column.sort_by(f64::total_cmp));
        let at = |i: usize, p: f64| inference::diagnostics::quantile(&columns[i], p);
        let published = published();
        let row = |(i, name): (usize, &String)| {
            let s = &reference.summary[i];
            let known = published.iter().find(|(n, _)| n == name).map_or("".to_owned(), |(_, v)| format!("{v:.3}"));
            vec![
                name.clone(),
                notation(pooled.column(i).mean(), [at(i, 0.025), at(i, 0.16), at(i, 0.84), at(i, 0.975)]),
                notation(s.mean, [s.q025, s.q16, s.q84, s.q975]),
                known,
            ]
        };
        let mean = pooled.row_mean();
        let band = Band {
            label: "-22 -> +22 A, four subsets pooled".into(),
            centre: mean.iter().copied().collect(),
            inner: (0..names.len()).map(|i| (at(i, 0.16), at(i, 0.84))).collect(),
            outer: (0..names.len()).map(|i| (at(i, 0.025), at(i, 0.975))).collect(),
        };
        let axes =
            Axes::new("Strength of each quadrupole over its design: bars 68 %, lines 95 %", "quadrupole", "var [1]");
        let axes = axes.named(&names).compared(Reference::Level(1.0));
        let header = ["var", "four subsets -22 -> +22 A pooled", "all frames", "published"];
        Section {
            heading: "The quadrupoles' strengths".into(),
            text: vec!["Mean, and in brackets the distances of the 68 % and of the 95 % band. The published column holds the means of the \
                        paper's final table, to the digits that are known here; its widths are not."
                .into()],
            figures: vec![(
                "Posterior of every var, from the paper's data mode and from all frames.".into(),
                Figure::bands(&axes, &[band, reference.band("all frames")]),
            )],
            tables: vec![Table {
                caption: "Final table.".into(),
                header: header.map(str::to_owned).to_vec(),
                rows: names.iter().enumerate().map(row).collect(),
            }],
        }
    }
}

/// Mean with the distances of the 68 % and the 95 % band.
fn notation(mean: f64, [q025, q16, q84, q975]: [f64; 4]) -> String {
    let mm = |q: f64| format!("{:+.4}", q - mean);
    format!("{mean:.4} ({} {}) ({} {})", mm(q16), mm(q84), mm(q025), mm(q975))
}

/// Means of the published final table.
fn published() -> Vec<(String, f64)> {
    let text = include_str!("published.csv");
    let line = |line: &str| {
        let (name, value) = line.split_once(',').expect("a name and a value");
        (name.to_owned(), value.parse().expect("a number"))
    };
    text.lines().skip(1).map(line).collect()
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    inference::diagnostics::quantile(values, 0.5)
}
