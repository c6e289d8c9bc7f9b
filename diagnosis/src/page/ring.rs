//! The ring with the findings marked.

use estimator::MonitorState;
use twin::Ring;

use super::lattice::{magnets, positions};
use super::monitors::word;
use crate::Diagnosis;
use crate::data::Data;
use report::{Figure, Look, RingMap, Section, Spotted};

/// Alternatives that are marked for each finding.
const ALTERNATIVES: usize = 4;

/// The map.
pub fn section(diagnosis: &Diagnosis) -> Section {
    let ring = &diagnosis.found.data.ring;
    let (mut spotted, mut everywhere) = (Vec::new(), Vec::new());
    for finding in &diagnosis.findings {
        let others = finding.alternatives.iter().take(ALTERNATIVES).map(|other| (other, Look::Alternative));
        for (one, look) in core::iter::once((finding, Look::Finding)).chain(others) {
            let places = positions(ring, one);
            let label = format!("{} {}", one.word().replace('_', " "), one.at);
            let label = if look == Look::Alternative { format!("or {label}") } else { label };
            match places.is_empty() {
                true => everywhere.push(format!("{label} (whole ring)")),
                false => spotted.extend(places.into_iter().map(|s| Spotted { label: label.clone(), s, look })),
            }
        }
    }
    let data = &diagnosis.found.data;
    spotted.extend(faulty(data));
    let figure = Figure::ring_map(&RingMap { title: title(diagnosis), spotted, everywhere, ..empty(ring) });
    let what = if diagnosis.findings.is_empty() {
        ""
    } else {
        "filled squares are findings, open circles alternatives to them, "
    };
    let unread = unread(ring);
    let unread =
        if unread.is_empty() { "all monitors are read".into() } else { format!("not read: {}", unread.join(", ")) };
    let caption = format!(
        "The ring; {what}crosses faulty monitors. Names inside the path are labels: a quadrupole, monitor or corrector is named by its label. Of \
         the monitors, {unread}."
    );
    Section { heading: "Where it is".into(), figures: vec![(caption, figure)], ..Section::default() }
}

fn title(diagnosis: &Diagnosis) -> String {
    let ring = &diagnosis.found.data.ring;
    let faulty = faulty(&diagnosis.found.data).len();
    let instruments = match faulty {
        0 => "all monitors in order".to_owned(),
        1 => "one faulty monitor".to_owned(),
        _ => format!("{faulty} faulty monitors"),
    };
    let findings = match diagnosis.findings.len() {
        0 => "nothing found".to_owned(),
        1 => "one finding".to_owned(),
        many => format!("{many} findings"),
    };
    format!("{}, {:.2} m: {findings}, {instruments}", ring.name, ring.circumference)
}

/// Monitors that are not in state ok, with the word for it.
fn faulty(data: &Data) -> Vec<Spotted> {
    let ring = &data.ring;
    let of = |(b, health): (usize, &estimator::Health)| {
        let at = ring.monitors[ring.read_monitors[b]].element;
        let label = format!("{} {}", ring.monitor_names()[b], word(health.state));
        (health.state != MonitorState::Ok).then(|| Spotted { label, s: ring.elements[at].s, look: Look::Faulty })
    };
    data.health().iter().enumerate().filter_map(of).collect()
}

/// Names of the monitors that are not read.
fn unread(ring: &Ring) -> Vec<String> {
    (0..ring.monitors.len()).filter(|at| !ring.read_monitors.contains(at)).map(|at| ring.monitor_name(at)).collect()
}

/// The ring without anything marked.
fn empty(ring: &Ring) -> RingMap {
    let names: Vec<(String, f64)> = (ring.quadrupoles.iter())
        .map(|q| &ring.elements[q.element])
        .map(|magnet| (magnet.label.clone(), magnet.s + 0.5 * magnet.length))
        .collect();
    RingMap {
        circumference: ring.circumference,
        sectors: sectors(ring),
        names,
        magnets: magnets(ring),
        ..RingMap::default()
    }
}

/// Sectors begin where their first element does.
fn sectors(ring: &Ring) -> Vec<(String, f64)> {
    let mut sectors: Vec<(String, f64)> = Vec::new();
    for element in &ring.elements {
        let Some(sector) = &element.sector else { continue };
        if sectors.last().is_none_or(|(last, _)| last != sector) {
            // the first one at the start of the ring
            let s = if sectors.is_empty() { 0.0 } else { element.s };
            sectors.push((sector.clone(), s));
        }
    }
    sectors
}
