//! What the recording would have shown: the decisive picture where nothing was found.

use diagnosis::{Diagnosis, Limits, SEEN, at_places};
use report::{Axes, Figure, Range, Series};
use twin::EffectKind;

use super::lattice::{STRIP, strip};

/// Limits of all kinds, and those of gradients along the ring.
pub fn figures(diagnosis: &Diagnosis) -> Vec<(String, Figure)> {
    vec![by_kind(diagnosis), along(diagnosis)]
}

fn by_kind(diagnosis: &Diagnosis) -> (String, Figure) {
    let scanned = &diagnosis.found.next.scanned;
    let mut all: Vec<(Limits, f64)> = EffectKind::ALL
        .iter()
        .filter_map(|&kind| Some((Limits::from_scan(kind, scanned)?, kind.prior_scale()?)))
        .collect();
    all.sort_by(|(one, by), (other, than)| (one.median / by).total_cmp(&(other.median / than)));
    let range = |(limits, scale): &(Limits, f64)| Range {
        label: limits.kind.word().replace('_', " "),
        values: [limits.least, limits.median, limits.at_most].map(|limit| limit / scale),
        text: limits.kind.unit().rounded(limits.median),
    };
    let entries: Vec<Range> = all.iter().map(range).collect();
    let title = "Nothing was found; these effects would have been";
    let axes = Axes::new(title, "detection limit over the size of a typical fault [1]", "");
    let caption = format!(
        "The amplitude from which on each kind of effect gives a ln Bayes factor of {SEEN:.0}, over the standard deviation of its prior: at the \
         best place (left end), at half of the places (marker, in figures on the right), at nine in ten (right end). Kinds right of the dashed line are \
         seen only where they are larger than typical."
    );
    (caption, Figure::ranges(&axes, &entries))
}

fn along(diagnosis: &Diagnosis) -> (String, Figure) {
    let found = &diagnosis.found;
    let series = |kind: EffectKind, label: &str| {
        let mut places: Vec<(f64, f64)> = at_places(kind, &found.next.scanned)
            .filter_map(|(term, limit)| Some((term.position(&found.data.ring)?, 1e3 * limit)))
            .collect();
        places.sort_by(|one, other| one.0.total_cmp(&other.0));
        let (s, limit) = places.into_iter().unzip();
        Series::points(label, s, limit)
    };
    let series = [
        series(EffectKind::StrayGradient, "normal gradient in a straight"),
        series(EffectKind::StraySkewGradient, "skew gradient in a straight"),
    ];
    let title = "Integrated gradients above these would have been found";
    let axes = Axes::new(title, "s [m]", "detection limit [1e−3 /m]").along(strip(diagnosis));
    (
        format!(
            "The same limit for a gradient in each straight: a smaller normal one is absorbed by the strengths beside it. {STRIP}"
        ),
        Figure::lines(&axes, &series),
    )
}
