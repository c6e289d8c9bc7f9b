//! Time of a frame in each of the cores, on a simulated ring that nearly fills it, with ten frames a second: the answer, the answer behind the longest slice of work
//! that it may wait for, and what was done until the next one. `cargo bench -p system-tests --bench rooms -- CELLS ..`; a table of docs/large-rings.md.

use core::error::Error;
use core::time::Duration;
use std::time::Instant;

use estimator::Prepared;
use host_bridge::source::Times;
use inference::simulate;
use inference::stream::{self, Walk};
use system_tests::cells;

/// Cells of the rings, of two quadrupoles each, and how many of them have two monitors a plane.
const RINGS: [(usize, usize); 5] = [(20, 0), (48, 16), (64, 64), (128, 0), (256, 64)];
/// Time from one frame to the next.
const PERIOD: Duration = Duration::from_millis(100);
/// Monitors and correctors of a plane, quadrupoles; time until the core is ready [s]; median and 99th percentile of the answer, the same and the largest behind the
/// longest slice, and median with all work [ms]; linearisations, and pull of the vars after the campaign.
const NAMES: [&str; 11] =
    ["monitors", "correctors", "quads", "start/s", "p50", "p99", "slice p50", "slice p99", "all p50", "anew", "pull"];

fn main() -> Result<(), Box<dyn Error>> {
    println!("{}", NAMES.map(|name| format!("{name:>11}")).concat());
    let chosen: Vec<usize> = std::env::args().filter_map(|one| one.parse().ok()).collect();
    for (number, further) in RINGS.into_iter().filter(|(number, _)| chosen.is_empty() || chosen.contains(number)) {
        let row = measure(number, further)?.map(|number| format!("{number:>11.2}"));
        println!("{}", row.concat());
    }
    Ok(())
}

/// The numbers of one ring.
fn measure(cells: usize, further: usize) -> Result<[f64; NAMES.len()], Box<dyn Error>> {
    let ring = cells::ring(cells, further);
    let vars = simulate::vars(&ring, false, 1)?;
    let recording = cells::campaign(&ring, 1 + 4 * cells, &vars);
    let start = Instant::now();
    let mut core = stream::estimator(&ring, &recording, Walk::NONE)?;
    let ready = start.elapsed().as_secs_f64();
    let (mut times, mut last, mut anew) = (Times::default(), None, 0);
    for row in &recording.rows {
        let mut wire = stream::wire(&recording, row)?;
        let start = Instant::now();
        times.preparing(|| if start.elapsed() < PERIOD { core.slice() } else { Prepared::Nothing });
        let estimate = times.of(|| core.ingest(&mut wire))?;
        anew += u32::from(estimate.linearised);
        last = Some(estimate);
    }
    let (last, timing) = (last.ok_or("a campaign has frames")?, times.quantiles());
    let each = vars.iter().zip(last.map_params.iter().zip(&last.params_sigma));
    let pulls = each.map(|(var, (map, sigma))| ((f64::from(*map) - var.ln()) / f64::from(*sigma)).powi(2));
    let pull = (pulls.sum::<f64>() / vars.len() as f64).sqrt();
    let [monitors, correctors, quadrupoles] = [cells + further, cells, 2 * cells].map(|number| number as f64);
    let [p50, p99, slice_p50, slice_p99, all_p50] =
        [timing.update_us_p50, timing.update_us_p99, timing.frame_us_p50, timing.frame_us_p99, timing.prepared_us_p50]
            .map(|us| 1e-3 * us);
    Ok([monitors, correctors, quadrupoles, ready, p50, p99, slice_p50, slice_p99, all_p50, f64::from(anew), pull])
}
