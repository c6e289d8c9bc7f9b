//! The ring with the findings marked.

use twin::{Class, Kind, Ring};

use crate::{Diagnosis, Finding};
use report::{Figure, Magnet, RingMap, Section, Spotted, Symbol};

/// Alternatives that are marked for each finding.
const ALTERNATIVES: usize = 4;

/// The map.
pub fn section(diagnosis: &Diagnosis) -> Section {
    let ring = &diagnosis.found.data.ring;
    let (mut spotted, mut everywhere) = (Vec::new(), Vec::new());
    for finding in &diagnosis.findings {
        let others = finding.alternatives.iter().take(ALTERNATIVES).map(|other| (other, true));
        for (one, pale) in core::iter::once((finding, false)).chain(others) {
            let places = positions(ring, one);
            let label = format!("{} {}", one.word().replace('_', " "), one.at);
            match places.is_empty() {
                true if pale => everywhere.push(format!("or {label} (whole ring)")),
                true => everywhere.push(format!("{label} (whole ring)")),
                false => spotted.extend(places.into_iter().map(|s| Spotted { label: named(&label, pale), s, pale })),
            }
        }
    }
    let figure = Figure::ring_map(&RingMap { spotted, everywhere, ..empty(ring) });
    let caption = if diagnosis.findings.is_empty() {
        "The ring; nothing was found, so nothing is marked. Names inside the path are labels."
    } else {
        "The ring; filled squares are findings, open circles alternatives to them. Names inside the path are labels: a quadrupole, \
         monitor or corrector is named by its label."
    };
    Section { heading: "Location".into(), figures: vec![(caption.into(), figure)], ..Section::default() }
}

fn named(label: &str, pale: bool) -> String {
    if pale { format!("or {label}") } else { label.to_owned() }
}

/// Positions of a finding: two for exchanged monitors, none for an effect on the whole ring.
fn positions(ring: &Ring, finding: &Finding) -> Vec<f64> {
    let Some(term) = finding.term() else { return finding.s.into_iter().collect() };
    match term.kind.class() {
        Class::Monitor(_) | Class::Corrector(_) | Class::Field(_) => term.site.positions(ring),
        Class::Hold(_) | Class::Drift(_) => Vec::new(),
    }
}

/// The ring without anything marked.
fn empty(ring: &Ring) -> RingMap {
    let symbol = |kind: &Kind| match kind {
        Kind::Bend(_) => Some(Symbol::Bend),
        Kind::Quadrupole { k1 } if *k1 > 0.0 => Some(Symbol::Focusing),
        Kind::Quadrupole { .. } => Some(Symbol::Defocusing),
        Kind::Monitor => Some(Symbol::Monitor),
        Kind::Corrector { .. } => Some(Symbol::Corrector),
        _ => None,
    };
    let magnets = ring
        .elements
        .iter()
        .filter_map(|element| Some(Magnet { symbol: symbol(&element.kind)?, s: element.s, length: element.length }));
    let names: Vec<(String, f64)> = (ring.quadrupoles.iter())
        .map(|q| &ring.elements[q.element])
        .map(|magnet| (magnet.label.clone(), magnet.s + 0.5 * magnet.length))
        .collect();
    RingMap {
        title: format!("{}, {:.2} m", ring.name, ring.circumference),
        circumference: ring.circumference,
        sectors: sectors(ring),
        names,
        magnets: magnets.collect(),
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
