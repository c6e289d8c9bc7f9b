//! Every kind of figure on one page, from made-up numbers: `cargo run --example gallery -- gallery.html`.

use std::path::PathBuf;

use nalgebra::DMatrix;
use report::{Axes, Band, Figure, Page, Panel, Reference, Section, Series, Table};

fn main() -> std::io::Result<()> {
    let path = std::env::args().nth(1).map_or(PathBuf::from("gallery.html"), PathBuf::from);
    let page = Page {
        title: "Gallery of figures".into(),
        lead: "Every number on this page is made up; the page shows what figures look like, on screen and on paper."
            .into(),
        sections: vec![magnets(), readings(), correlations(), calibration()],
    };
    page.write(&path)
}

fn magnets() -> Section {
    let axes = Axes::new("Gradient errors, made up", "magnet", "gradient / design [1]");
    let axes = axes.named(&names()).compared(Reference::Level(1.0));
    let few = Axes::new("Six magnets, made up", "magnet", "gradient / design [1]").named(&names()[..6]);
    let group = |label, seed, width| band(label, 48, seed, width);
    let groups = [
        group("prior", 1.0, 0.020),
        group("orbits of one day", 2.0, 0.012),
        group("orbits of one week", 3.0, 0.006),
        group("with dispersion", 4.0, 0.005),
        group("exact reference", 5.0, 0.005),
    ];
    Section {
        heading: "Magnets".into(),
        text: vec!["Thick bars hold 68 %, thin bars 95 % of the probability.".into()],
        figures: vec![
            (
                "Five groups over 48 magnets: 24 that focus horizontally, then 24 vertically.".into(),
                Figure::bands(&axes, &groups),
            ),
            (
                "Two groups over six magnets.".into(),
                Figure::bands(&few, &[band("before", 6, 1.0, 0.02), band("after", 6, 2.0, 0.004)]),
            ),
        ],
        tables: vec![table()],
    }
}

fn readings() -> Section {
    let place: Vec<f64> = (0..=200).map(f64::from).collect();
    let wave = |size: f64, phase: f64| place.iter().map(|s| size * (0.13 * s + phase).sin()).collect::<Vec<_>>();
    let orbit = |label, size, phase| Series::line(label, place.clone(), wave(size, phase));
    let model = orbit("model, 95 % band", 2.0, 0.0).within(wave(2.0, 0.0).iter().map(|x| (x - 0.4, x + 0.4)).collect());
    let (at, read): (Vec<f64>, Vec<f64>) = (0..33).map(|b| (6.1 * f64::from(b), reading(f64::from(b)))).unzip();
    let bars = read.iter().map(|x| (x - 0.3, x + 0.3)).collect();
    let lines = [
        model,
        orbit("second", 1.5, 0.6),
        orbit("third", 1.2, 1.2),
        orbit("fourth", 1.0, 1.8),
        orbit("fifth", 0.8, 2.4),
    ];
    let points = [lines[0].clone(), Series::points("readings, one sigma", at, read).within(bars)];
    let orbit_axes = |title| Axes::new(title, "path length [m]", "horizontal position [mm]");
    Section {
        heading: "Lines, points, densities".into(),
        figures: vec![
            ("Five lines, the first with its band.".into(), Figure::lines(&orbit_axes("Orbits, made up"), &lines)),
            (
                "Readings with error bars on the orbit of a model.".into(),
                Figure::lines(&orbit_axes("Readings, made up"), &points),
            ),
            ("A series over the names of magnets.".into(), named_series()),
            ("Predicted against measured.".into(), scatter()),
            ("Three probability densities.".into(), densities()),
        ],
        ..Section::default()
    }
}

fn named_series() -> Figure {
    let axes = Axes::new("Shrinkage, made up", "magnet", "posterior sigma / prior sigma [1]").named(&names());
    let shrink = |seed: f64| (0..48).map(|m| 0.5 + 0.4 * noise(f64::from(m) + 50.0 * seed)).collect::<Vec<_>>();
    let place: Vec<f64> = (0..48).map(f64::from).collect();
    Figure::lines(
        &axes,
        &[Series::points("green", place.clone(), shrink(1.0)), Series::points("resnet", place, shrink(2.0))],
    )
}

fn scatter() -> Figure {
    let axes = Axes::new("Fit, made up", "measured kick response [\u{b5}m]", "predicted [\u{b5}m]")
        .compared(Reference::Diagonal);
    let series = |label, seed: f64, spread: f64| {
        let x: Vec<f64> = (0..40).map(|i| 90.0 * noise(f64::from(i) + seed)).collect();
        let y = x.iter().enumerate().map(|(i, x)| x + spread * noise(i as f64 + 2.0 * seed)).collect();
        Series::points(label, x, y)
    };
    Figure::lines(&axes, &[series("twin", 10.0, 4.0), series("green", 77.0, 9.0), series("resnet", 177.0, 6.0)])
}

fn densities() -> Figure {
    let axes = Axes::new("Gradient of A2, made up", "gradient / design [1]", "probability density [1]");
    let x: Vec<f64> = (0..=300).map(|i| 0.97 + 0.0002 * f64::from(i)).collect();
    let bell = |label, mean: f64, sigma: f64| {
        let density = |x: &f64| (-0.5 * ((x - mean) / sigma).powi(2)).exp() / (sigma * core::f64::consts::TAU.sqrt());
        Series::line(label, x.clone(), x.iter().map(density).collect())
    };
    Figure::densities(
        &axes,
        &[bell("prior", 1.0, 0.01), bell("Gaussian", 1.004, 0.004), bell("sampled", 1.005, 0.0045)],
    )
}

fn correlations() -> Section {
    let matrix = |size| {
        DMatrix::from_fn(size, size, |row, column| {
            let apart = row.abs_diff(column) as f64;
            (-apart / 6.0).exp() * (0.9 * apart).cos()
        })
    };
    let map = |title, size: usize| Figure::heat_map(title, "correlation [1]", &names()[..size], &matrix(size));
    Section {
        heading: "Correlations".into(),
        figures: vec![
            ("All 48 magnets.".into(), map("Correlations of 48 gradients, made up", 48)),
            ("Eight magnets.".into(), map("Correlations of eight gradients, made up", 8)),
        ],
        ..Section::default()
    }
}

fn calibration() -> Section {
    let axes = Axes::new("Calibration of 33 monitors, made up", "nominal probability [1]", "observed share [1]");
    let panels: Vec<Panel> = (0..33).map(monitor).collect();
    Section {
        heading: "Calibration".into(),
        figures: vec![(
            "Observed share of readings below each nominal quantile; the area holds 95 % of what chance allows.".into(),
            Figure::small_multiples(&axes.compared(Reference::Diagonal), &panels),
        )],
        ..Section::default()
    }
}

fn monitor(number: u32) -> Panel {
    let nominal: Vec<f64> = (0..=20).map(|i| f64::from(i) / 20.0).collect();
    let band = nominal.iter().map(|p| (p - 0.2 * (p * (1.0 - p)).sqrt(), p + 0.2 * (p * (1.0 - p)).sqrt())).collect();
    let bend = 0.3 * noise(f64::from(number));
    let observed = |sign: f64| nominal.iter().map(|p| p + sign * bend * p * (1.0 - p)).collect();
    Panel {
        name: format!("R{}HM{}", 1 + number / 5, 1 + number % 5),
        series: vec![
            Series::line("with gain errors, 95 % band of chance", nominal.clone(), observed(1.0)).within(band),
            Series::line("without", nominal.clone(), observed(-2.0)),
        ],
    }
}

fn table() -> Table {
    let row = |magnet: usize| {
        let value = 1.0 + 0.01 * noise(magnet as f64);
        vec![names()[magnet].clone(), format!("{value:.4}"), "0.0052".into(), "determined by orbits".into()]
    };
    Table {
        caption: "Four magnets, made up.".into(),
        header: ["magnet", "gradient / design [1]", "sigma [1]", "remark"].map(String::from).to_vec(),
        rows: (0..4).map(row).collect(),
    }
}

fn band(label: &str, count: u32, seed: f64, width: f64) -> Band {
    let centre: Vec<f64> = (0..count).map(|m| 1.0 + 0.02 * noise(f64::from(m) + 100.0 * seed)).collect();
    let around = |half: f64| centre.iter().map(|c| (c - half, c + half)).collect();
    Band { label: label.into(), inner: around(width), outer: around(2.0 * width), centre }
}

/// A2 to F8, then A1 to F7: focusing horizontally, then vertically.
fn names() -> Vec<String> {
    let half =
        |first: u32| ('A'..='F').flat_map(move |sextant| (0..4).map(move |n| format!("{sextant}{}", first + 2 * n)));
    half(2).chain(half(1)).collect()
}

fn reading(monitor: f64) -> f64 {
    2.0 * (0.13 * 6.1 * monitor).sin() + 0.4 * noise(monitor)
}

/// A number between -1 and 1 that looks random.
fn noise(seed: f64) -> f64 {
    2.0 * (43_758.545 * (12.9898 * seed + 0.1).sin()).rem_euclid(1.0) - 1.0
}
