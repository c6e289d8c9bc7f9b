//! Chi-square per reading, by monitor, corrector, sign of the kick and time.

use diagnosis::Data;
use report::{Axes, Figure, Reference, Section, Series, Table};

use super::residuals::{Residual, Residuals};
use super::table;

/// Stretches of time.
const STRETCHES: usize = 8;
/// Distance of two markers of a name, as a share of the distance of two names.
const APART: f64 = 0.17;
/// Chi-square from which on the axis is logarithmic.
const LOGARITHMIC: f64 = 8.0;

/// A group of residuals: its name, and the test of membership.
type Group = (String, Box<dyn Fn(&Residual) -> bool>);

/// Mean square of some residuals.
#[derive(Debug, Clone, Copy, Default)]
struct Chi2 {
    sum: f64,
    readings: usize,
}

impl Chi2 {
    fn of<'r>(residuals: impl Iterator<Item = &'r Residual>) -> Self {
        residuals
            .fold(Self::default(), |all, one| Self { sum: all.sum + one.value * one.value, readings: all.readings + 1 })
    }

    fn per_reading(self) -> f64 {
        if self.readings == 0 { f64::NAN } else { self.sum / self.readings as f64 }
    }
}

/// By monitor, by corrector, by sign of the kick, by time.
pub fn section(data: &Data, residuals: &[Residuals]) -> Section {
    let (monitors, correctors) = (data.active_monitors(), data.driven_correctors());
    let (monitor_names, corrector_names) = (data.ring.monitor_names(), data.ring.corrector_names());
    let by_monitor = by(residuals, &monitors, |one| Some(one.monitor));
    let by_corrector = by(residuals, &correctors, |one| one.kick.map(|(corrector, _)| corrector));
    let figure = |title: &str, label: &str, of: &[usize], names: &[String], series: Vec<Series>| {
        let names: Vec<String> = of.iter().map(|&i| names[i].clone()).collect();
        let largest = series.iter().flat_map(|one| &one.y).copied().fold(0.0, f64::max);
        let last = &series[series.len() - 1];
        let worst = (0..names.len()).filter(|&i| !last.y[i].is_nan()).max_by(|&i, &j| last.y[i].total_cmp(&last.y[j]));
        let title = worst.map_or(title.to_owned(), |i| format!("{title}: largest at {}", names[i]));
        let axes = Axes::new(&title, label, "chi-square per reading [1]").named(&names).compared(Reference::Level(1.0));
        Figure::lines(&if largest > LOGARITHMIC { axes.logarithmic() } else { axes }, &series)
    };
    let kicked = residuals[0].all.iter().filter(|one| one.kick.is_some()).count() as f64;
    let scatter = |members: usize| (2.0 * members as f64 / kicked.max(1.0)).sqrt();
    Section {
        heading: "Structure of the residuals".into(),
        text: vec![format!(
            "Mean square of the residuals in units of their noise. The expected value is 1, less the share of degrees of freedom that baselines \
                 and vars take; in-plane are readings of x while an H corrector is powered and of y while a V corrector is, cross-plane \
                 the others. Noise alone scatters a marker by {:.2} (by monitor) and {:.2} (by corrector). Monitors that are noisy or \
                 jump are weighted by a larger noise than they have in most frames, so that their chi-square is low.",
            scatter(monitors.len()),
            scatter(correctors.len())
        )],
        figures: vec![
            (
                "By monitor. A faulty monitor stands out in its own column; a fault of the ring raises many.".into(),
                figure("Chi-square per reading by monitor", "monitor", &monitors, &monitor_names, by_monitor),
            ),
            (
                "By corrector. A faulty corrector stands out in its own column; a fault of the ring raises many."
                    .into(),
                figure("Chi-square per reading by corrector", "corrector", &correctors, &corrector_names, by_corrector),
            ),
        ],
        tables: vec![groups(residuals)],
    }
}

/// Before and after, for each of some monitors or correctors.
fn by(residuals: &[Residuals], members: &[usize], of: impl Fn(&Residual) -> Option<usize>) -> Vec<Series> {
    let series = |(i, one): (usize, &Residuals)| {
        let mine = |r: &&Residual, member: usize| of(r) == Some(member) && r.kick.is_some();
        let value = |&member: &usize| Chi2::of(one.all.iter().filter(|r| mine(r, member))).per_reading();
        let shift = APART * (i as f64 - 0.5 * (residuals.len() as f64 - 1.0));
        let x = (0..members.len()).map(|i| i as f64 + shift).collect();
        Series::points(one.name, x, members.iter().map(value).collect())
    };
    residuals.iter().enumerate().map(series).collect()
}

/// By sign of the kick and by stretch of time.
fn groups(residuals: &[Residuals]) -> Table {
    let sign = |wanted: f64| move |one: &Residual| one.kick.map_or(0.0, |(_, sign)| sign) == wanted;
    let stretch = |i: usize| {
        let edge = |i: usize| -1.0 + 2.0 * i as f64 / STRETCHES as f64;
        move |one: &Residual| one.time >= edge(i) && (one.time < edge(i + 1) || i + 1 == STRETCHES)
    };
    let mut groups: Vec<Group> = vec![
        ("all".into(), Box::new(|_| true)),
        ("kick +".into(), Box::new(sign(1.0))),
        ("kick \u{2212}".into(), Box::new(sign(-1.0))),
        ("no kick".into(), Box::new(sign(0.0))),
    ];
    for i in 0..STRETCHES {
        groups.push((format!("time, {} of {STRETCHES}", i + 1), Box::new(stretch(i))));
    }
    let row = |(name, holds): &Group| {
        let readings = residuals[0].all.iter().filter(|one| holds(one)).count();
        let cell = |one: &Residuals, plane: Option<bool>| {
            let mine = |r: &&Residual| holds(r) && plane.is_none_or(|plane| r.kick.is_some() && r.in_plane == plane);
            let chi2 = Chi2::of(one.all.iter().filter(mine));
            if chi2.readings == 0 { "\u{2013}".into() } else { format!("{:.3}", chi2.per_reading()) }
        };
        let (first, last) = (&residuals[0], residuals.last().unwrap_or(&residuals[0]));
        let pair = |plane| [cell(first, plane), cell(last, plane)];
        let [[a, b], [c, d], [e, f]] = [None, Some(true), Some(false)].map(pair);
        let error = (2.0 / readings.max(1) as f64).sqrt();
        [name.clone(), readings.to_string(), a, b, c, d, e, f, format!("{error:.3}")]
    };
    let header = [
        "readings",
        "count",
        "all, before",
        "after",
        "in-plane, before",
        "after",
        "cross-plane, before",
        "after",
        "σ of noise (all)",
    ];
    let caption = "Chi-square per reading by sign of the kick and by stretch of time, without any effect (before) and with the effects \
                   found (after). The last column is the standard deviation that noise alone gives a mean over all readings of the row.";
    table(caption, header, groups.iter().map(row).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_are_told_apart_and_the_kick_counted() {
        let one = |in_plane, sign: f64, value| Residual {
            pool: 0,
            noise: 1.0,
            monitor: 3,
            kick: (sign != 0.0).then_some((5, sign)),
            in_plane,
            time: 0.0,
            value,
        };
        let all = vec![one(true, 1.0, 2.0), one(true, -1.0, 1.0), one(false, 1.0, 3.0), one(false, 0.0, 7.0)];
        let series = by(&[Residuals { name: "before", all }], &[3, 4], |residual| Some(residual.monitor));
        assert!((series[0].y[0] - 14.0 / 3.0).abs() < 1e-12, "without a kick a reading is of no corrector");
        assert!(series[0].y[1].is_nan(), "a monitor without readings has no marker");
        let row =
            &groups(&[Residuals { name: "before", all: vec![one(true, 1.0, 2.0), one(false, 1.0, 3.0)] }]).rows[1];
        assert_eq!([&row[1], &row[4], &row[6]], ["2", "4.000", "9.000"], "{row:?}");
    }
}
