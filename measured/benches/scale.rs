//! Time and memory of fit, diagnosis and comparison against the size of a ring: a ring of cells with errors, measured with noise.
//!
//! `cargo bench -p measured --bench scale -- 60 100 400x470x413x7700` prints a line a size, each in a process of its own, and the exponents of the gradients that
//! times and memory grow with. A size is a number of gradients, with as many readings and kicks, or all three and how many rows the lattice has. The table of
//! docs/large-rings.md.

use core::error::Error;
use core::f64::consts::TAU;
use core::iter::repeat_n;
use core::str::FromStr;
use std::fs;
use std::process::Command;
use std::time::Instant;

use measured::folder::{CorrectorRow, Folder, Meta, MonitorRow, Particle, Row};
use measured::unknowns::{Kind, Widths, groups, unknowns};
use measured::{Diagnosis, Model, Settings, Straightened, compare};
use nalgebra::{DMatrix, DVector};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand_distr::{Distribution, StandardNormal};
use twin::{Hold, Optics, Plane, Rf};

/// Noise of an element of the matrix [mm].
const NOISE: f64 = 0.002;
/// Gradients up to which diagnosis and comparison are timed: beyond they take many minutes.
const MOST: usize = 400;
/// Columns: gradients, response with its instruments' derivatives, all columns of the Jacobian, fit, diagnosis, comparison [s], memory [MB].
const NAMES: [&str; 8] =
    ["gradients", "response/s", "jacobian/s", "fit/s", "fit/MB", "pull", "diagnose/s", "compare/s"];

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|one| one != "--bench").collect();
    if let [one, size] = arguments.as_slice()
        && one == "one"
    {
        println!("{}", measure(size.parse()?)?.map(|number| number.to_string()).join(" "));
        return Ok(());
    }
    println!("{}", NAMES.map(|name| format!("{name:>11}")).concat());
    let mut lines = Vec::new();
    for size in if arguments.is_empty() { ["60", "100", "200", "400"].map(String::from).to_vec() } else { arguments } {
        let output = Command::new(std::env::current_exe()?).args(["one", &size]).output()?;
        if !output.status.success() {
            return Err(format!("{size}: {}", String::from_utf8_lossy(&output.stderr).trim()).into());
        }
        let numbers = String::from_utf8(output.stdout)?;
        let numbers: Vec<f64> = numbers.split_whitespace().map(str::parse).collect::<Result<_, _>>()?;
        println!("{}", numbers.iter().map(|number| format!("{number:>11.3}")).collect::<String>());
        lines.push(numbers);
    }
    let slopes = (1..NAMES.len()).map(|column| format!("{:>11.2}", exponent(&lines, column)));
    println!("{:>11}{}", "exponent", slopes.collect::<String>());
    Ok(())
}

/// Slope of `ln` of a column against `ln` of the first one, by least squares.
fn exponent(lines: &[Vec<f64>], column: usize) -> f64 {
    let points = lines.iter().filter_map(|line| Some([line[0].ln(), line.get(column)?.ln()])).collect::<Vec<_>>();
    let mean = |which: usize| points.iter().map(|point| point[which]).sum::<f64>() / points.len() as f64;
    let (x, y) = (mean(0), mean(1));
    let across: f64 = points.iter().map(|point| (point[0] - x) * (point[1] - y)).sum();
    across / points.iter().map(|point| (point[0] - x).powi(2)).sum::<f64>()
}

/// Size of a ring and of its matrix.
#[derive(Clone, Copy)]
struct Size {
    gradients: usize,
    readings: usize,
    kicks: usize,
    rows: usize,
}

impl FromStr for Size {
    type Err = Box<dyn Error>;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.split('x').map(str::parse).collect::<Result<Vec<usize>, _>>()?[..] {
            [all] => Ok(Self { gradients: all, readings: all, kicks: all, rows: 0 }),
            [gradients, readings, kicks, rows] => Ok(Self { gradients, readings, kicks, rows }),
            _ => Err(format!("{text}: expected GRADIENTS or GRADIENTSxREADINGSxKICKSxROWS").into()),
        }
    }
}

/// The numbers of one size.
fn measure(size: Size) -> Result<[f64; 8], Box<dyn Error>> {
    let (ring, gradients) = (ring(size), size.gradients);
    let (before, truth) = measured_with_errors(&ring, 2)?;
    let settings = Settings::default();
    let groups = groups(&before);
    let (model, all) =
        (Model::of(&before, &groups, settings.rf)?, unknowns(&before, &groups, true, &Widths::default()));
    let means = DVector::from_iterator(all.len(), all.iter().map(|one| one.mean));
    // the cells' focusing has stopbands, and beyond their edge a fit is of no ring
    Optics::of(&model.at(&all, &means), Hold::Frequency { offset: 0.0 })?.twiss()?;
    let (response, prediction) = timed(|| model.predict(&all, &means));
    let prediction = prediction?;
    let columns = 0..prediction.matrix.ncols();
    let (jacobian, _) = timed(|| columns.map(|column| prediction.by_machine.columns(&[column]).sum()).sum::<f64>());
    let (fit, straightened) = timed(|| Straightened::of(&before, &settings, &mut |_| ()));
    let Straightened { folder, cables, fit: fitted } = straightened?;
    let memory = peak()?;
    let pulls = (0..gradients).map(|at| ((fitted.values[at] - truth[at]) / fitted.sigma(at)).powi(2));
    let pull = (pulls.sum::<f64>() / gradients as f64).sqrt();
    let (mut diagnosis, mut comparison) = (f64::NAN, f64::NAN);
    if gradients <= MOST {
        let (time, found) = timed(|| Diagnosis::of_fit((&folder, &cables), &fitted, &settings, &mut |_| ()));
        found?;
        diagnosis = time;
        let (after, _) = measured_with_errors(&ring, 3)?;
        let (time, changes) = timed(|| compare(&before, &after, &settings, &mut |_| ()));
        changes?;
        comparison = time;
    }
    Ok([gradients as f64, response, jacobian, fit, memory, pull, diagnosis, comparison])
}

/// A result and how long it took [s].
fn timed<T>(make: impl FnOnce() -> T) -> (f64, T) {
    let start = Instant::now();
    let made = make();
    (start.elapsed().as_secs_f64(), made)
}

/// Most memory that this process has had [MB].
fn peak() -> Result<f64, Box<dyn Error>> {
    let status = fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).ok_or("Linux states VmHWM")?;
    Ok(line.trim().trim_end_matches(" kB").parse::<f64>()? / 1024.0)
}

/// Cells of two quadrupoles and a dipole, among which monitors and correctors are spread, each of both planes but for an odd one; drifts are cut until there are so
/// many rows.
fn ring(size: Size) -> Folder {
    let cells = size.gradients / 2;
    let (mut lattice, mut s) = (Vec::new(), 0.0);
    let (mut monitors, mut correctors) = (Vec::new(), Vec::new());
    // a cell has at least six rows, two of which are drifts
    let pieces = (size.rows / cells).saturating_sub(6).div_ceil(2) + 1;
    for cell in 0..cells {
        let [monitors_here, horizontal, vertical] = [size.readings / 2, size.kicks.div_ceil(2), size.kicks / 2]
            .map(|count| (cell + 1) * count / cells - cell * count / cells);
        let (windings, mut wound) = (horizontal.max(vertical).max(1), 0);
        let monitor = |count: usize| repeat_n(("BPM", 0.0, 0.0, 0.0), count);
        let drift = |length: f64| repeat_n(("L", length / pieces as f64, 0.0, 0.0), pieces);
        let rows = monitor(monitors_here.min(1))
            .chain(drift(0.4))
            .chain([("QF", 0.3, 0.0, 4.0)])
            .chain(repeat_n(("COR", 0.2 / windings as f64, 0.0, 0.0), windings))
            .chain([("B", 1.2, TAU / cells as f64, 0.0), ("QD", 0.3, 0.0, -3.0)])
            .chain(monitor(monitors_here.saturating_sub(1)))
            // no symmetry: cells that are all alike have modes that errors of gradients excite together
            .chain(drift(0.6 + 0.2 * f64::from(u8::from(cell % 3 != 0))));
        for (name, length, bend, k1) in rows {
            let (at, planes, edge) = (lattice.len(), [Plane::X, Plane::Y], bend / 2.0);
            match name {
                "BPM" => monitors.extend(planes.map(|plane| MonitorRow { plane, at, sigma: NOISE, is_used: true })),
                "COR" => {
                    let planes = planes.into_iter().zip([horizontal, vertical]).filter(|(_, count)| *count > wound);
                    correctors.extend(planes.map(|(plane, _)| CorrectorRow { plane, at, kick: 0.2, is_used: true }));
                    wound += 1;
                }
                _ => {}
            }
            lattice.push(Row {
                name: name.into(),
                s,
                length,
                bend,
                edge_in: edge,
                edge_out: edge,
                fringe: 0.0,
                k1,
                half_k2: 0.0,
            });
            s += length;
        }
    }
    monitors.sort_by_key(|one| one.plane.index());
    correctors.sort_by_key(|one| one.plane.index());
    let meta = Meta {
        circumference: s,
        energy: Some(6.0),
        particle: Particle::Electron,
        rf: 5e8,
        delta_rf: 2e2,
        reference_fit: None,
    };
    let matrix = DMatrix::zeros(monitors.len(), correctors.len());
    let dispersion = Some(DVector::zeros(monitors.len()));
    Folder { name: format!("{cells} cells"), meta, lattice, monitors, correctors, matrix, dispersion }
}

/// The ring measured with some noise, always with the same errors: strengths off by 0.3 %, gains by 2 % and couplings by 0.5 %, and the values of its unknowns.
fn measured_with_errors(ring: &Folder, noise: u64) -> Result<(Folder, DVector<f64>), Box<dyn Error>> {
    let normal = |seed: u64| {
        let mut random = StdRng::seed_from_u64(seed);
        move || -> f64 { StandardNormal.sample(&mut random) }
    };
    let (mut error, mut noise) = (normal(1), normal(noise));
    let groups = groups(ring);
    let all = unknowns(ring, &groups, true, &Widths::default());
    let size = |kind: Kind| match kind {
        Kind::Strength(_) => 0.003,
        Kind::MonitorGain(_) | Kind::CorrectorGain(_) => 0.02,
        Kind::MonitorCoupling(_) | Kind::CorrectorCoupling(_) => 0.005,
        _ => 0.0,
    };
    let truth = DVector::from_iterator(all.len(), all.iter().map(|one| one.mean + size(one.kind) * error()));
    let seen = Model::of(ring, &groups, Rf::FixedFrequency)?.predict(&all, &truth)?.matrix;
    let seen = seen.map(|element| element + NOISE * noise());
    let correctors = ring.correctors.len();
    let (matrix, dispersion) = (seen.columns(0, correctors).into_owned(), seen.column(correctors).into_owned());
    Ok((Folder { matrix, dispersion: Some(dispersion), ..ring.clone() }, truth))
}
