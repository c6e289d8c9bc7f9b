//! The time that `Ring.response()` of the Booster takes in Rust alone: optics, stability and the response of 33 monitors to 48
//! correctors, as in `src/response.rs`; the median in us.
use std::time::Instant;

use twin::{Hold, Optics, Ring};

fn main() {
    let ring = Ring::booster();
    let mut times: Vec<f64> = (0..2001).map(|_| time(&ring)).collect();
    times.sort_by(f64::total_cmp);
    println!("{:.1}", times[times.len() / 2]);
}

fn time(ring: &Ring) -> f64 {
    let start = Instant::now();
    let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 }).expect("the Booster is stable");
    let made = optics.response(&optics.read_monitors(), &optics.correctors());
    let seconds = start.elapsed().as_secs_f64();
    assert!(made[(0, 0)].is_finite());
    1e6 * seconds
}
