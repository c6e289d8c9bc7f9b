//! The ring with the findings marked.

use diagnosis::{Data, Diagnosis};
use estimator::MonitorState;
use report::{Figure, Look, RingMap, Section, Spotted};
use twin::{Parameter, Ring};

use super::lattice::{magnets, positions};
use super::monitors::word;

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
    spotted.extend(out_of_range(diagnosis));
    spotted.extend(faulty(data));
    let figure = Figure::ring_map(&RingMap { title: title(diagnosis), spotted, everywhere, ..empty(ring) });
    let what = if diagnosis.findings.is_empty() && diagnosis.beyond.is_empty() {
        ""
    } else {
        "filled squares are findings and quadrupoles out of their range, open circles alternatives to findings, "
    };
    let unread = unread(ring);
    let unread =
        if unread.is_empty() { "all monitors are read".into() } else { format!("not read: {}", unread.join(", ")) };
    let caption = format!(
        "The ring; {what}crosses faulty and wandering monitors. Names inside the path are labels: a quadrupole, monitor or corrector is named by its label. Of \
         the monitors, {unread}."
    );
    Section { heading: "Where it is".into(), figures: vec![(caption, figure)], ..Section::default() }
}

fn title(diagnosis: &Diagnosis) -> String {
    let data = &diagnosis.found.data;
    let (ring, wandering) = (&data.ring, data.noise.wandering.len());
    let of = |count: usize, what: &str| match count {
        0 => None,
        1 => Some(format!("one {what}")),
        _ => Some(format!("{count} {what}s")),
    };
    let instruments = [of(faulty(data).len() - wandering, "faulty monitor"), of(wandering, "wandering monitor")];
    let instruments: Vec<String> = instruments.into_iter().flatten().collect();
    let instruments = if instruments.is_empty() { "all monitors in order".to_owned() } else { instruments.join(", ") };
    let outside =
        of(diagnosis.beyond.len(), "quadrupole").map_or(String::new(), |some| format!(", {some} out of range"));
    let findings = of(diagnosis.findings.len(), "finding").unwrap_or_else(|| "nothing found".into());
    format!("{}, {:.2} m: {findings}{outside}, {instruments}", ring.name, ring.circumference)
}

/// Quadrupoles beyond their range.
fn out_of_range(diagnosis: &Diagnosis) -> Vec<Spotted> {
    let ring = &diagnosis.found.data.ring;
    let is_beyond = |parameter: &&Parameter| diagnosis.beyond.iter().any(|one| one.name == parameter.name);
    let of = |&quadrupole: &usize| {
        let magnet = &ring.elements[ring.quadrupoles[quadrupole].element];
        let label = format!("{} out of range", magnet.label);
        Spotted { label, s: magnet.s + 0.5 * magnet.length, look: Look::Finding }
    };
    ring.parameters.iter().filter(is_beyond).flat_map(|parameter| parameter.quadrupoles.iter().map(of)).collect()
}

/// Monitors that are not in state ok, with the word for it, and those that wander.
fn faulty(data: &Data) -> Vec<Spotted> {
    let (ring, names) = (&data.ring, data.ring.monitor_names());
    let spotted = |b: usize, word: &str| {
        let at = ring.monitors[ring.read_monitors[b]].element;
        Spotted { label: format!("{} {word}", names[b]), s: ring.elements[at].s, look: Look::Faulty }
    };
    let faulty = data.health().iter().enumerate().filter(|(_, health)| health.state != MonitorState::Ok);
    let faulty = faulty.map(|(b, health)| spotted(b, word(health.state)));
    faulty.chain(data.noise.wandering.iter().map(|(b, _)| spotted(*b, "wanders"))).collect()
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
