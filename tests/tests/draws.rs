//! Convergence diagnostics against ArviZ 0.23, on chains that have one fault each (`tests/peers/arviz_diagnostics.py`).

use inference::{Chain, DrawStats, Draws, Summary};
use system_tests::repository;

/// Sums in another order, and ArviZ's autocovariance by FFT; the largest measured is 3e-13, of a quantity that is small
/// against its mean.
const ROUNDING: f64 = 1e-11;

/// ArviZ on a quantity: name, then `r_hat`, `ess_bulk`, `ess_tail` and `mcse_mean`.
type Row = (String, [f64; 4]);

fn draws() -> Draws {
    let (names, chains): (Vec<_>, Vec<_>) = (1..=4).map(chain).unzip();
    Draws { names: names[0].clone(), chains }
}

/// Names of the quantities and their draws, from a CSV file as CmdStan writes it: the sampler's statistics come first.
fn chain(number: usize) -> (Vec<String>, Chain) {
    let text = std::fs::read_to_string(repository(&format!("tests/golden/draws/chain-{number}.csv"))).unwrap();
    let mut lines = text.lines().map(|line| line.split(','));
    let names = lines.next().unwrap().skip(7).map(String::from).collect();
    let mut chain = Chain::default();
    for cells in lines {
        let mut cells = cells.map(|cell| cell.parse().unwrap());
        let [lp, acceptance, step_size, depth, leapfrogs, divergent, energy] =
            core::array::from_fn(|_| cells.next().unwrap());
        let (depth, leapfrogs, divergent) = (depth as u64, leapfrogs as u64, divergent == 1.0);
        chain.stats.push(DrawStats { lp, acceptance, step_size, depth, leapfrogs, divergent, energy });
        chain.draws.push(cells.collect());
    }
    (names, chain)
}

fn of_arviz() -> Vec<Row> {
    let text = std::fs::read_to_string(repository("tests/golden/arviz.csv")).unwrap();
    let row = |line: &str| {
        let (name, figures) = line.split_once(',').unwrap();
        let figures: Vec<f64> = figures.split(',').map(|figure| figure.parse().unwrap()).collect();
        (name.to_owned(), figures.try_into().unwrap())
    };
    text.lines().skip(1).map(row).collect()
}

fn ours(summary: &Summary) -> Row {
    let Summary { name, r_hat, ess_bulk, ess_tail, mcse_mean, .. } = summary;
    (name.clone(), [*r_hat, *ess_bulk, *ess_tail, *mcse_mean])
}

#[test]
fn diagnostics_are_those_of_arviz() {
    let ours: Vec<Row> = draws().summary().iter().map(ours).collect();
    let theirs = of_arviz();
    assert_eq!(ours.len(), theirs.len());
    for ((name, ours), (their_name, theirs)) in ours.iter().zip(&theirs) {
        assert_eq!(name, their_name);
        let error = ours.iter().zip(theirs).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f64::max);
        assert!(error < ROUNDING, "{name}: off by {error:.1e}, allowed {ROUNDING:.0e}: {ours:?}, ArviZ {theirs:?}");
    }
}

#[test]
fn divergences_of_the_golden_chains_are_counted() {
    let draws = draws();
    assert_eq!((draws.chains.len(), draws.divergences()), (4, 1));
    assert!(draws.chains[3].stats[100].divergent);
    let doublings = |chain: &inference::Chain| chain.stats.iter().all(|stats| stats.leapfrogs + 1 == 1 << stats.depth);
    assert!(draws.chains.iter().all(doublings));
}

#[test]
fn every_fault_is_found_where_it_is() {
    let draws = draws();
    let found = draws.summary().into_iter().filter(|summary| summary.r_hat > 1.01).map(|summary| summary.name);
    assert_eq!(found.collect::<Vec<_>>(), ["slow", "shifted", "wide"]);
}
