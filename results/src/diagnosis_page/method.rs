//! How the numbers of the page are made.

use diagnosis::{CHANCE, DECISIVE, Diagnosis, FitError, SUPPORTED, SUSPICIOUS, VALIDATED};
use inference::recording::Recording;
use report::Section;

use super::table;

/// The foot of the page.
///
/// # Errors
/// [`FitError`].
pub fn section(diagnosis: &Diagnosis, recording: &Recording) -> Result<Section, FitError> {
    let found = &diagnosis.found;
    let [before, after] = [found.null.chi2_per_dof(&found.data)?, found.best.chi2_per_dof(&found.data)?];
    let minutes = recording.rows.last().map_or(0.0, |last| (last.time - recording.rows[0].time) / 60.0);
    let effects = if found.has_more() { format!(", {after:.3} with what was found") } else { String::new() };
    let text = format!(
        "Recording {}: {} frames in {minutes:.0} minutes, recorded with {}. Noise of a reading by its header {:.0} µm. Chi-square per degree of \
         freedom {before:.3} without any effect{effects}.",
        recording.name,
        recording.rows.len(),
        recording.header.recorded_with,
        found.data.mean_noise * 1e6,
    );
    let row = |name: &str, how: String| [name.to_owned(), how];
    let rows = vec![
        row(
            "model",
            "Exact twin of the ring with the strengths of all quadrupoles, the effects, and the ordinary imperfections (gains, rolls, common factors) as \
             unknowns u in units of their prior standard deviations; baselines, supplies and noise as learnt enter by the covariance of the readings, which whitens \
             the residuals r."
                .into(),
        ),
        row(
            "amplitude ± σ",
            "The most likely value, and its standard deviation with all other unknowns adapting: the diagonal of (1 + JᵀJ)⁻¹, J the derivative of the whitened \
             predictions."
                .into(),
        ),
        row(
            "gain [nat]",
            "ln evidence with the effect less that without it, both refitted: ln evidence = −(|r|² + |u|²)/2 − ln det(1 + JᵀJ)/2 + ln(share within the \
             range of the strengths). An unmodelled discrepancy has free amplitudes, which are integrated out."
                .into(),
        ),
        row(
            "P",
            "Prior times evidence over the sum of all candidates, of unmodelled discrepancies and of nothing. Prior: nothing is missing in half of \
             all campaigns; else 15 % for physics outside the library, and the rest shared equally by the kinds, and by the places of a kind; one effect more beside \
             others has odds of 1 to 4. Of causes outside the library 4 % are taken to look like an effect: no effect has more than P = 0.993."
                .into(),
        ),
        row(
            "held-out gain [nat]",
            "Readings are left out in blocks, a frame never split: a block is a run of frames of one setting (a pool), and for effects that are not one \
             corrector's own, in a second table, all frames of one corrector. The other frames predict them: sum over the left-out readings of \
             ln N(reading; prediction, its variance), with all effects less without this one. Its standard error is √(n · variance of the n differences)."
                .into(),
        ),
        row(
            "of the choice [nat]",
            "The same where kind and place are chosen anew among all candidates without a fifth of the runs, which the chosen one then predicts: an effect that was \
             chosen by chance has less than zero on average."
                .into(),
        ),
        row(
            "chance",
            "Share of 500 searches, this one and 499 of recordings drawn from this machine with nothing missing, in which the best candidate is as good."
                .into(),
        ),
        row(
            "verdict",
            format!(
                "identified: every effect has P ≥ {DECISIVE}, a held-out gain above {VALIDATED:.0} standard errors ({SUPPORTED:.0} where chance is at most {CHANCE}) and one of the choice above zero, and nothing further is suspected; for an instrument beside an ordinary scatter of its like a held-out gain above zero will do where chance is at most {CHANCE}. Otherwise consistent: all that can be seen has P ≤ {SUSPICIOUS:.1}; \
                 unexplained: what can be seen of other physics than the library's has P > {SUSPICIOUS:.1}; ambiguous: the rest."
            ),
        ),
        row(
            "chi-square per degree of freedom",
            "Sum of (residual/noise)² of the monitors in state ok about their baselines, over readings less baselines less strengths; the noise is the one learnt from \
             repeats."
                .into(),
        ),
    ];
    Ok(Section {
        heading: "How each number is made".into(),
        text: vec![text],
        tables: vec![table(
            "In short; docs/diagnosis.md has the derivations and their sources.",
            ["number", "how it is made"],
            rows,
        )],
        ..Section::default()
    })
}
