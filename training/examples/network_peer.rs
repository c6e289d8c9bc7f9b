//! A random network and a batch with outputs and derivatives, for `tests/peers/torch_network.py`; and how many samples a second are learnt.
//!
//! `cargo run --release -p training --example network_peer -- target/peer`

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use nalgebra::DMatrix;
use rand::SeedableRng;
use rand::rngs::StdRng;
use training::network::fit::{self, Plan, Trainee, columns};
use training::network::layers::{Network, Pass};
use training::network::samples::Source;
use twin::Ring;

/// Samples of the batch.
const BATCH: usize = 256;
/// Chunks that are timed.
const TIMED: usize = 4;

fn main() -> std::io::Result<()> {
    let folder = PathBuf::from(env::args().nth(1).expect("a folder"));
    fs::create_dir_all(&folder)?;
    let source = Source::of(&Ring::booster());
    let samples = &source.samples(BATCH / 16, 7)[0];
    let network = Network::random(source.inputs(0), samples.targets.nrows(), &mut StdRng::seed_from_u64(1));
    let (inputs, targets) = (columns(&samples.inputs, 0, BATCH), columns(&samples.targets, 0, BATCH));
    let mut pass = Pass::new(&network, BATCH);
    let outputs = pass.forward(&network, &inputs).clone();
    let mut slopes = network.clone();
    pass.backward(&network, &inputs, &((&outputs - targets) * (2.0 / BATCH as f32)), &mut slopes);
    let by_input = pass.input_slopes(&network, &DMatrix::from_element(outputs.nrows(), BATCH, 1.0));
    let write = |name: &str, numbers: &mut dyn Iterator<Item = &f32>| floats(&folder.join(name), numbers);
    write("inputs", &mut inputs.iter())?;
    write("targets", &mut targets.iter())?;
    write("outputs", &mut outputs.iter())?;
    write("network", &mut network.slices().flatten())?;
    write("slopes", &mut slopes.slices().flatten())?;
    write("by_input", &mut by_input.iter())?;
    let plan = Plan::FULL;
    let mut planes = [0, 1].map(|plane| Trainee::new(&source, plane, &plan));
    let validation = fit::validation(&source);
    fit::learn(&source, &plan, &mut planes, &validation);
    let start = Instant::now();
    (0..TIMED).for_each(|_| fit::learn(&source, &plan, &mut planes, &validation));
    let samples = (2 * 24 * TIMED * plan.machines) as f64;
    println!(
        "{:.0} samples a second, both planes together, drawing them included",
        samples / start.elapsed().as_secs_f64()
    );
    Ok(())
}

/// Little-endian numbers.
fn floats(path: &Path, numbers: &mut dyn Iterator<Item = &f32>) -> std::io::Result<()> {
    fs::write(path, numbers.flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>())
}
