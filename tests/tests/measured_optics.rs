//! Beta and tunes of fitted matrices of a 1.37 GeV ring against those that one quadrupole after the other was changed for.
//!
//! Such a run sets a magnet to half a step below and above its gradient and reads both tunes each time. The fitted ring is asked for the same:
//! its tunes at both gradients, coupled as it is.

use measured::{FittedRing, Folder, Settings, Straightened};
use nalgebra::DVector;
use serde_json::Value;
use system_tests::measured_ring;
use twin::{Hold, Kind, Optics, OrbitError, Ring};

/// A magnet's middle [m], the step of its integrated gradient [1/m], and both tunes below and above.
struct Shunt {
    s: f64,
    step: f64,
    tunes: [[f64; 2]; 2],
}

/// Gradients of a quadrupole reach over so much [m]: its halves lie beside its middle.
const LENGTH: f64 = 0.27;

fn shunts(day: &str) -> Option<Vec<Shunt>> {
    let text = std::fs::read_to_string(measured_ring("uvx/quad-shunt")?.join(format!("beta_{day}.json"))).unwrap();
    let file: Value = serde_json::from_str(&text).unwrap();
    let pair = |value: &Value| [0, 1].map(|plane| value[plane].as_f64().unwrap());
    let shunt = |one: &Value| Shunt {
        s: one["s_m"].as_f64().unwrap(),
        step: (one["K1"].as_f64().unwrap() - one["K0"].as_f64().unwrap()) * LENGTH,
        tunes: [pair(&one["tunes0"]), pair(&one["tunes1"])],
    };
    Some(file["quads"].as_array().unwrap().iter().map(shunt).collect())
}

fn tunes(ring: &Ring) -> Result<[f64; 2], OrbitError> {
    let tunes = Optics::of(ring, Hold::Momentum { delta: 0.0 })?.tunes()?;
    Ok([tunes.x, tunes.y])
}

/// What the run would find on a ring: the change of both tunes for each magnet, then the tunes.
fn run(ring: &Ring, shunts: &[Shunt]) -> Result<DVector<f64>, OrbitError> {
    let mut found = Vec::new();
    for one in shunts {
        let at = |share: f64| {
            let mut ring = ring.clone();
            for element in &mut ring.elements {
                let is_half = (element.s + 0.5 * element.length - one.s).abs() < 0.5 * LENGTH;
                if let (true, Kind::Quadrupole { k1 }) = (is_half, &mut element.kind) {
                    *k1 += share * one.step / LENGTH;
                }
            }
            tunes(&ring)
        };
        let (below, above) = (at(-0.5)?, at(0.5)?);
        found.extend([0, 1].map(|plane| above[plane] - below[plane]));
    }
    found.extend(tunes(ring)?);
    Ok(DVector::from_vec(found))
}

#[test]
fn fitted_beta_is_that_of_changed_quadrupoles() {
    for (day, folder) in [
        ("2012-08-25_07-10-40", "families_3/before"),
        ("2013-06-22_14-55-17", "families_2/before"),
        ("2013-06-22_16-44-46", "families_2/after"),
        ("2013-06-22_17-32-34", "null_1/before"),
        ("2013-06-22_18-05-14", "null_1/after"),
    ] {
        let (Some(shunts), Some(path)) = (shunts(day), measured_ring(&format!("uvx/{folder}"))) else { return };
        let settings = Settings::default();
        let straightened = Straightened::of(&Folder::read(&path).unwrap(), &settings, &mut |_| ()).unwrap();
        let fitted = FittedRing::of(&straightened.folder, &straightened.fit, &settings).unwrap();
        let [found, sigma] = fitted.functions(|ring| run(ring, &shunts)).unwrap();
        println!("# {day} tunes {:?}", (found[72], sigma[72], found[73], sigma[73]));
        for (i, one) in shunts.iter().enumerate() {
            println!(
                "{day} {} {} {:?} {:?} {:?}",
                one.s,
                one.step,
                one.tunes,
                [found[2 * i], found[2 * i + 1]],
                [sigma[2 * i], sigma[2 * i + 1]]
            );
        }
    }
}
