//! What a sampler leaves: draws of named quantities chain by chain, with how each one came about.

use crate::diagnostics::{ess_bulk, ess_tail, mcse_mean, mean, quantile, r_hat, sorted, variance};

/// Draws of all chains.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Draws {
    /// Names of the quantities; elements of a vector are `vars.1`, `vars.2`, as of CmdStan [N].
    pub names: Vec<String>,
    /// Chains of equal length.
    pub chains: Vec<Chain>,
}

/// One chain after its warm-up.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Chain {
    /// Draws in the order of time, each in the order of the names [draws][N].
    pub draws: Vec<Vec<f64>>,
    /// How each draw came about [draws].
    pub stats: Vec<DrawStats>,
}

/// How Hamiltonian Monte Carlo came to a draw.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DrawStats {
    /// Log-density of the draw up to a constant [nat].
    pub lp: f64,
    /// Mean acceptance probability along the trajectory [1].
    pub acceptance: f64,
    /// Step size of the integrator [1].
    pub step_size: f64,
    /// Doublings of the trajectory.
    pub depth: u64,
    /// Steps of the integrator.
    pub leapfrogs: u64,
    /// The energy error grew beyond bounds, so that the posterior is too sharp for the step size here.
    pub divergent: bool,
    /// Hamiltonian at the draw: kinetic energy less `lp` [nat].
    pub energy: f64,
}

/// One quantity's posterior and how far to trust it; all but the last three in the quantity's unit.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// The quantity.
    pub name: String,
    /// Mean of all draws.
    pub mean: f64,
    /// Standard deviation of all draws, `Σ(x − x̄)²/(n − 1)` under the root.
    pub sd: f64,
    /// 2.5 % quantile.
    pub q025: f64,
    /// 16 % quantile.
    pub q16: f64,
    /// 84 % quantile.
    pub q84: f64,
    /// 97.5 % quantile.
    pub q975: f64,
    /// Monte Carlo standard error of the mean (`mcse_mean`).
    pub mcse_mean: f64,
    /// Agreement of the chains (`r_hat`) [1].
    pub r_hat: f64,
    /// Effective sample size of the middle (`ess_bulk`) [1].
    pub ess_bulk: f64,
    /// Effective sample size of the tails (`ess_tail`) [1].
    pub ess_tail: f64,
}

impl Draws {
    /// Draws of one quantity, chain by chain.
    ///
    /// # Panics
    /// If there is no such index.
    #[must_use]
    pub fn quantity(&self, index: usize) -> Vec<Vec<f64>> {
        let of_chain = |chain: &Chain| chain.draws.iter().map(|draw| draw[index]).collect();
        self.chains.iter().map(of_chain).collect()
    }

    /// Every quantity's posterior, in the order of the names.
    #[must_use]
    pub fn summary(&self) -> Vec<Summary> {
        self.names.iter().enumerate().map(|(index, name)| Summary::from_chains(name, &self.quantity(index))).collect()
    }

    /// Number of divergent draws in all chains.
    #[must_use]
    pub fn divergences(&self) -> usize {
        self.chains.iter().flat_map(|chain| &chain.stats).filter(|stats| stats.divergent).count()
    }
}

impl Summary {
    fn from_chains(name: &str, chains: &[Vec<f64>]) -> Self {
        let sorted = sorted(chains);
        Self {
            name: name.to_owned(),
            mean: mean(&sorted),
            sd: variance(&sorted).sqrt(),
            q025: quantile(&sorted, 0.025),
            q16: quantile(&sorted, 0.16),
            q84: quantile(&sorted, 0.84),
            q975: quantile(&sorted, 0.975),
            mcse_mean: mcse_mean(chains),
            r_hat: r_hat(chains),
            ess_bulk: ess_bulk(chains),
            ess_tail: ess_tail(chains),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chain(draws: &[[f64; 2]]) -> Chain {
        let stats = vec![DrawStats::default(); draws.len()];
        Chain { draws: draws.iter().map(|draw| draw.to_vec()).collect(), stats }
    }

    fn two_chains() -> Draws {
        let chains = vec![
            chain(&[[1.0, 9.0], [2.0, 9.0], [3.0, 9.0], [4.0, 9.0]]),
            chain(&[[5.0, 9.0], [6.0, 9.0], [7.0, 9.0], [8.0, 9.0]]),
        ];
        Draws { names: vec!["A2".into(), "vars.1".into()], chains }
    }

    #[test]
    fn quantity_is_chain_by_chain() {
        assert_eq!(two_chains().quantity(0), [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]]);
    }

    #[test]
    fn summary_of_one_to_eight() {
        let summary = &two_chains().summary()[0];
        assert_eq!((summary.name.as_str(), summary.mean, summary.sd), ("A2", 4.5, 6.0_f64.sqrt()));
        let quantiles = [summary.q025, summary.q16, summary.q84, summary.q975];
        let expected = [1.175, 2.12, 6.88, 7.825]; // 1 + 7p
        assert!(quantiles.iter().zip(expected).all(|(ours, exact)| (ours - exact).abs() < 1e-14), "{quantiles:?}");
    }

    #[test]
    fn summary_of_nothing_is_nan() {
        let nothing = Draws { names: vec!["A2".into()], chains: Vec::new() }.summary();
        assert!(nothing[0].mean.is_nan() && nothing[0].sd.is_nan() && nothing[0].q16.is_nan());
    }

    #[test]
    fn divergences_are_counted_over_chains() {
        let mut draws = two_chains();
        draws.chains.iter_mut().for_each(|chain| chain.stats[3].divergent = true);
        assert_eq!(draws.divergences(), 2);
    }
}
