//! Time of the twin on one core: its optics, the response of the Booster alone and from the ring on, and the response
//! with its derivative by all 48 vars (asked for: below 2 ms).

use divan::{Bencher, black_box};
use twin::{Hold, Optics, Plane, Ring, VariedRing};

fn main() {
    divan::main();
}

const ON_MOMENTUM: Hold = Hold::Momentum { delta: 0.0 };

/// Closed orbit, linear maps about it, tunes.
#[divan::bench]
fn optics(bencher: Bencher) {
    let ring = Ring::booster();
    bencher.bench_local(|| black_box(Optics::of(black_box(&ring), ON_MOMENTUM).unwrap()).tunes().unwrap());
}

/// 33 monitors by 48 correctors, the optics known.
#[divan::bench]
fn response(bencher: Bencher) {
    let ring = Ring::booster();
    let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
    bencher.bench_local(|| {
        let optics = black_box(&optics);
        optics.response(&optics.read_monitors(), &optics.correctors())
    });
}

/// The work of `tests/peers/pyat_response.py`: from the ring to x and y at 48 places for 48 correctors.
#[divan::bench]
fn full_response(bencher: Bencher) {
    let ring = Ring::booster();
    bencher.bench_local(|| {
        let optics = Optics::of(black_box(&ring), ON_MOMENTUM).unwrap();
        let correctors = optics.correctors();
        [Plane::X, Plane::Y].map(|plane| optics.response(&optics.monitor_places(plane), &correctors))
    });
}

/// Everything that one step of a fit needs, from the gradients on: optics, response and its derivative by 48 vars.
#[divan::bench]
fn response_with_jacobian(bencher: Bencher) {
    let (design, vars) = (Ring::booster(), [1.0; 48]);
    bencher.bench_local(|| {
        let ring = design.with_vars(black_box(&vars));
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let (observers, sources) = (optics.read_monitors(), optics.correctors());
        let jacobian = optics.response_jacobian(&observers, &sources, &optics.quadrupoles());
        (optics.response(&observers, &sources), jacobian)
    });
}

/// What one step of a sampler needs: the response, and the gradient of a function of it (asked for: below 0.5 ms).
#[divan::bench]
fn response_with_gradient(bencher: Bencher) {
    let (varied, vars) = (VariedRing::of(&Ring::booster()).unwrap(), [1.0; 48]);
    bencher.bench_local(|| {
        let optics = varied.at(black_box(&vars)).unwrap();
        let response = optics.response();
        optics.pull_back(&response)
    });
}
