//! The evidence for something that data may hold, in closed form.
//!
//! Data `d` with Gaussian noise of variance 1 may hold patterns `s_i` with amplitudes `a_i`, whose priors are normal with the standard deviations `w_i`
//! (widths) about 0. Of data and patterns two sums matter, the slope `g_i = s_i.d` and the curvature `G_ij = s_i.s_j` of the log-likelihood
//! at no amplitude. With `W = diag(w)`, integration over the amplitudes gives
//!
//! `ln Bayes factor = -ln det(1 + W G W)/2 + g W (1 + W G W)^-1 W g/2`
//!
//! over data without the patterns. The amplitudes' posterior has the mean `W (1 + W G W)^-1 W g` and the covariance `W (1 + W G W)^-1 W`.
//! [`Evidence`] is that of one amplitude, [`JointEvidence`] that of several. The determinant is the price of free amplitudes: one
//! that the data does not show costs evidence.
//!
//! Where a fit has unknowns of its own that adapt, slope and curvature are those of what the fit cannot absorb.
//!
//! ```
//! use evidence::Evidence;
//!
//! // a pattern of norm 2 in data without noise, its amplitude 3: g = 2 * 6, G = 4
//! let found = Evidence::from_score(12.0, 4.0, 1.0);
//! assert_eq!(found.amplitude, 12.0 / 5.0);
//! assert_eq!(found.log_bayes_factor, 144.0 / 10.0 - 5.0_f64.ln() / 2.0);
//! ```
//!
//! Source: R. E. Kass and A. E. Raftery, Bayes Factors, J. Am. Stat. Assoc. 90 (1995) 773, of a Gaussian the Laplace approximation is exact.

mod amplitude;
mod factor;
mod joint;

pub use amplitude::{Evidence, log_bayes_factor_of_alike};
pub use factor::{Factor, gram, symmetric};
pub use joint::{JointEvidence, log_bayes_factor};
