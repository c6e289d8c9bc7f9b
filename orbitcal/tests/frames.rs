//! `orbitcal frames`: raw orbits of a measured response streamed through the core, on a simulated ring and on two measured ones.
//!
//! The measurements have no licence and are not part of the repository. They are looked for in `ORBITCAL_MEASURED`, then in
//! `../shared/recordings/real` beside the checkout; a test that finds none says so and passes.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

const CELLS: &str = "recordings/measured/twelve-cells";

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn orbitcal(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_orbitcal")).args(arguments).current_dir(repository()).output().unwrap()
}

fn json(arguments: &[&str]) -> Value {
    let run = orbitcal(&[arguments, &["--json", "-", "--quiet"]].concat());
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    serde_json::from_slice(&run.stdout).unwrap()
}

fn refused(arguments: &[&str]) -> String {
    let run = orbitcal(arguments);
    assert_eq!(run.status.code(), Some(2), "{arguments:?}: {}", String::from_utf8_lossy(&run.stderr));
    String::from_utf8(run.stderr).unwrap()
}

/// Frames of a measurement, and what the core makes of them.
struct Streamed {
    frames: Value,
    replayed: Value,
}

impl Streamed {
    fn of(measurement: &[&str], out: &Path, walk: Option<f64>) -> Self {
        let out = out.to_str().unwrap();
        let frames = json(&[&["frames"], measurement, &["--out", out]].concat());
        let drift = ["x", "y"].map(|plane| frames[plane]["drift_um"].as_f64().unwrap());
        // as the command proposes
        let walk = walk.unwrap_or(drift[0].min(drift[1]) / 2f64.sqrt()).to_string();
        let [machine, model] = ["machine.json", "model"].map(|file| format!("{out}/{file}"));
        let replay = ["replay", out, "--machine", &machine, "--model-file", &model, "--no-publish", "--baseline-walk"];
        Self { frames, replayed: json(&[&replay[..], &[&walk]].concat()) }
    }

    /// Mean square of what the core's strengths are off others, over the variance of these.
    fn off(&self, by: impl Fn(&Value) -> f64) -> f64 {
        let vars = self.replayed["vars"].as_array().unwrap();
        vars.iter().map(|var| by(var).powi(2)).sum::<f64>() / vars.len() as f64
    }

    /// Off the fit of all orbits at once, by its error bars; and the core's error bars over these, on average.
    fn beside_the_fit(&self) -> (f64, f64) {
        let fitted = self.frames["vars"].as_array().unwrap();
        let one =
            |var: &Value| fitted.iter().find(|one| one["name"] == var["name"]).expect("params are those of the fit");
        let number = |of: &Value, key: &str| of[key].as_f64().unwrap();
        let off = self.off(|var| (number(var, "mean") - number(one(var), "mean")) / number(one(var), "sigma"));
        let vars = self.replayed["vars"].as_array().unwrap();
        let ratios = vars.iter().map(|var| number(var, "sigma") / number(one(var), "sigma"));
        (off.sqrt(), ratios.sum::<f64>() / vars.len() as f64)
    }

    fn chi2(&self) -> f64 {
        self.replayed["chi2_per_dof"].as_f64().unwrap()
    }
}

/// A folder of twelve cells with the raw orbits that its matrix may have come from: about an orbit that walks by 2 um from frame to frame.
fn with_raw_orbits(to: &Path) {
    fs::create_dir(to).unwrap();
    let from = repository().join(CELLS).join("before");
    for file in fs::read_dir(&from).unwrap().map(Result::unwrap) {
        fs::copy(file.path(), to.join(file.file_name())).unwrap();
    }
    let text = fs::read_to_string(from.join("orm_measured_mm.csv")).unwrap();
    let number = |field: &str| field.parse::<f64>().unwrap();
    let matrix: Vec<Vec<f64>> =
        text.lines().skip(1).map(|line| line.split(',').skip(1).map(number).collect()).collect();
    let mut seed = 1_u64;
    let mut uniform = || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as f64 / f64::from(1_u32 << 31) - 0.5
    };
    let rows: Vec<[String; 2]> = matrix
        .iter()
        .map(|row| {
            let mut orbit = uniform();
            let pairs: Vec<(f64, f64)> = row
                .iter()
                .map(|change| {
                    orbit += 0.002 * 2f64.sqrt() * 12f64.sqrt() * uniform();
                    (orbit - change / 2.0, orbit + change / 2.0)
                })
                .collect();
            let line = |of: fn(&(f64, f64)) -> f64| {
                pairs.iter().map(|pair| of(pair).to_string()).collect::<Vec<_>>().join(",")
            };
            [line(|pair| pair.0), line(|pair| pair.1)]
        })
        .collect();
    for (side, name) in ["minus", "plus"].into_iter().enumerate() {
        let lines: Vec<&str> = rows.iter().map(|row| row[side].as_str()).collect();
        fs::write(to.join(format!("raw_orbit_{name}_mm.csv")), lines.join("\n") + "\n").unwrap();
    }
    let amperes = vec![0.5; matrix[0].len()];
    fs::write(to.join("raw_orbit_meta.json"), serde_json::json!({ "actuator_delta_A": amperes }).to_string()).unwrap();
}

/// Two of its monitors are exchanged, instruments have gains and couplings: all that is found first, as on a real ring.
#[test]
fn raw_orbits_of_a_ring_with_wrong_cables_are_streamed() {
    let folder = tempfile::tempdir().unwrap();
    let (ring, out) = (folder.path().join("ring"), folder.path().join("frames"));
    with_raw_orbits(&ring);
    let ring = ring.to_str().unwrap();
    let streamed = Streamed::of(&[ring], &out, None);
    assert_eq!((&streamed.frames["frames"], &streamed.frames["params"]), (&48.into(), &24.into()));
    let drift = ["x", "y"].map(|plane| streamed.frames[plane]["drift_um"].as_f64().unwrap());
    // 23 steps of 12 monitors: known to 4 %, five times that
    assert!(drift.iter().all(|um| (um / (2.0 * 2f64.sqrt()) - 1.0).abs() < 0.2), "{drift:?}");
    let truth = fs::read_to_string(repository().join(CELLS).join("truth.json")).unwrap();
    let truth: Value = serde_json::from_str(&truth).unwrap();
    let nees = streamed.off(|var| {
        let true_one = truth["before"][var["name"].as_str().unwrap()].as_f64().unwrap();
        (var["mean"].as_f64().unwrap() - true_one) / var["sigma"].as_f64().unwrap()
    });
    let (off, widths) = streamed.beside_the_fit();
    println!(
        "NEES {nees:.2}, {off:.2} of the fit's error bars off it, error bars {widths:.2} of its, chi2/dof {:.2}",
        streamed.chi2()
    );
    // 24 squares scatter by 0.29: three times that; error bars are wider by the tables' stated error
    assert!(nees < 1.87, "{nees}");
    assert!(off < 1.0 && (0.8..4.0).contains(&widths), "{off} {widths}");
    let again = refused(&["frames", ring, "--out", out.to_str().unwrap()]);
    assert!(again.contains("it is not overwritten"), "{again}");
}

#[test]
fn what_frames_are_not_made_of_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("frames");
    let out = out.to_str().unwrap();
    let before = format!("{CELLS}/before");
    assert!(refused(&["frames", &before, "--out", out]).contains("expected raw_orbit_minus_mm.csv"));
    let alone = folder.path().join("alone");
    with_raw_orbits(&alone);
    fs::remove_file(alone.join("orm_measured_mm.csv")).unwrap();
    let alone = alone.to_str().unwrap();
    assert!(refused(&["frames", alone, "--out", out]).contains("--lattice says what they were read on"));
    let lattice = ["frames", alone, "--lattice", &before, "--out", out];
    assert!(refused(&lattice).contains("--monitors"));
    let wrong = [&lattice[..], &["--monitors", "12,11", "--correctors", "12,12"]].concat();
    assert!(refused(&wrong).contains("expected raw orbits of 23 readings and 24 correctors, found 24 and 24"));
    // with the counts its instruments are found by their responses
    let right = [&lattice[..], &["--monitors", "12,12", "--correctors", "12,12", "--quiet"]].concat();
    assert!(orbitcal(&right).status.success());
    assert!(Path::new(out).join("frames.csv").is_file());
}

/// The folder of a measured ring, if there is one.
fn measured(name: &str) -> Option<String> {
    let real = || repository().join("../shared/recordings/real");
    let folder = std::env::var_os("ORBITCAL_MEASURED").map_or_else(real, PathBuf::from).join(name);
    if !folder.is_dir() {
        eprintln!("{} is absent: not tested", folder.display());
        return None;
    }
    Some(folder.to_str().unwrap().into())
}

/// The core has the same orbits as the fit of all at once, in turn, with a walk of the baselines in place of differences; strengths of both are as far
/// apart as these differ in weight.
fn agrees(name: &str, streamed: &Streamed, most: f64, widths: core::ops::Range<f64>) {
    let (off, ratio) = streamed.beside_the_fit();
    let (frames, chi2) = (&streamed.frames["frames"], streamed.chi2());
    println!(
        "{name}: {frames} frames, {off:.2} of the fit's error bars off it, error bars {ratio:.2} of its, chi2/dof {chi2:.2}"
    );
    assert!(off < most && widths.contains(&ratio), "{off} {ratio}");
}

#[test]
fn the_orbits_of_sps_are_streamed() {
    let Some(sps) = measured("sps_2007") else { return };
    let folder = tempfile::tempdir().unwrap();
    let streamed = Streamed::of(&[&sps], &folder.path().join("frames"), None);
    assert_eq!(streamed.frames["frames"], 56);
    agrees("SPS", &streamed, 1.0, 0.7..1.4);
    assert!((0.8..1.3).contains(&streamed.chi2()), "{}", streamed.chi2());
}

/// Its monitors and correctors have no names: they are those of the lattice of another day. The tables' stated error, of kicks five times as large and strengths
/// that may be anything within their prior, is ten times the noise: error bars are wider by it.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn the_orbits_of_als_are_streamed() {
    let (Some(raw), Some(lattice)) = (measured("als_20070105_raw"), measured("als_2005_topoff")) else { return };
    let folder = tempfile::tempdir().unwrap();
    let arguments = [&raw[..], "--lattice", &lattice, "--monitors", "122,122", "--correctors", "95,73"];
    let streamed = Streamed::of(&arguments, &folder.path().join("frames"), None);
    assert_eq!((&streamed.frames["frames"], &streamed.frames["monitors"]), (&336.into(), &242.into()));
    agrees("ALS", &streamed, 1.5, 0.8..5.0);
}
