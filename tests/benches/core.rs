//! Time of the core on one core of the host: a whole frame, and each step of its path.

use divan::{Bencher, black_box};
use estimator::booster::{
    self, CHANNELS, CORRECTORS, COUPLINGS, Drive, Frame, Green, MONITORS, PARAMS, Prediction, SUPPLIES, TRIANGLE, WORDS,
};
use estimator::{Correlated, Gaussian, Layout, Prior, Reading, Solution, Surrogate, Walk};
use host_bridge::source::Times;
use inference::stream::{self, Core};
use inference::{Recording, StreamError};
use results::Timing;
use system_tests::repository;
use twin::Ring;

const LAYOUT: Layout = Layout { ring: booster::SIZES, room: booster::SIZES };

fn main() {
    divan::main();
    println!("\n{}", whole_frames());
}

/// Campaigns over which whole frames are timed.
const CAMPAIGNS: usize = 5;

/// Each frame in its turn, with what the core does between frames: medians and 99th percentiles, which divan has not.
fn whole_frames() -> Timing {
    let (campaign, mut times) = (Campaign::read(), Times::default());
    for mut core in vec![campaign.core; CAMPAIGNS] {
        for mut wire in campaign.wires.clone() {
            times.preparing(|| core.slice());
            times.of(|| core.ingest(black_box(&mut wire))).unwrap();
        }
    }
    times.quantiles()
}

type Linearised = <Green as Surrogate<MONITORS, CORRECTORS, SUPPLIES, PARAMS>>::Linearised;

/// Frames of `recordings/paper-vars` as wire bytes, and a core that has ingested some of them.
struct Campaign {
    wires: Vec<Vec<u8>>,
    core: Core,
}

impl Campaign {
    fn read() -> Self {
        let ring = Ring::booster();
        let recording = Recording::read(&repository("recordings/paper-vars"), &ring).unwrap();
        let wires = recording.rows.iter().map(|row| stream::wire(&recording, row)).collect::<Result<_, StreamError>>();
        Self { wires: wires.unwrap(), core: stream::estimator(&ring, &recording, Walk::NONE).unwrap() }
    }

    /// The core just before each frame, and the frame.
    fn frames(mut self) -> Vec<(Core, Vec<u8>)> {
        let mut frames = Vec::new();
        for wire in &self.wires {
            self.core.prepare();
            frames.push((self.core.clone(), wire.clone()));
            self.core.ingest(&mut wire.clone()).unwrap();
        }
        frames
    }

    /// The core just before each relinearisation.
    fn linearisations(mut self) -> Vec<Core> {
        let mut before = Vec::new();
        for wire in &self.wires {
            self.core.ingest(&mut wire.clone()).unwrap();
            let core = self.core.clone();
            if self.core.prepare() {
                before.push(core);
            }
        }
        before
    }
}

/// A frame from its bytes to the estimate, over a campaign; divan's median is then that over its frames.
#[divan::bench(sample_count = 1000, sample_size = 1)]
fn frame(bencher: Bencher) {
    let frames = Campaign::read().frames();
    let mut next = frames.iter().cycle();
    bencher
        .with_inputs(|| next.next().expect("a cycle does not end").clone())
        .bench_local_values(|(mut core, mut wire)| (core.ingest(black_box(&mut wire)), core));
}

/// Between frames: the surrogate relinearised and all settings so far counted again.
#[divan::bench(sample_size = 1)]
fn linearise_anew(bencher: Bencher) {
    let before = Campaign::read().linearisations();
    let mut next = before.iter().cycle();
    bencher
        .with_inputs(|| next.next().expect("a cycle does not end").clone())
        .bench_local_values(|mut core| (core.prepare(), core));
}

/// Bytes to frame: COBS, CRC, body, ranges.
#[divan::bench]
fn decode(bencher: Bencher) {
    let wire = Campaign::read().wires.swap_remove(100);
    bencher.with_inputs(|| wire.clone()).bench_local_refs(|wire| Frame::decode(&LAYOUT, wire).unwrap());
}

/// Frame to bytes.
#[divan::bench]
fn encode(bencher: Bencher) {
    let frame = Frame::decode(&LAYOUT, &mut Campaign::read().wires[100]).unwrap();
    bencher
        .with_inputs(|| [0; Frame::MAX_WIRE_BYTES])
        .bench_local_refs(|bytes| black_box(&frame).encode(&LAYOUT, bytes).unwrap());
}

/// Tables, linearised at vars of a few per cent, and what they predict of one powered corrector and the stray currents of the
/// others.
fn predicted() -> (Box<Green>, Box<Linearised>, Drive, Box<Prediction>) {
    let core = Campaign::read().core;
    let frame = Frame::decode(&LAYOUT, &mut Campaign::read().wires[100]).unwrap();
    let setup: booster::Setup = core.setup.in_room(&LAYOUT);
    let drive = setup.calibration.drive(&frame).unwrap();
    let mut tables = Box::new(Green::BLANK);
    core.tables.fill(&mut *tables).unwrap();
    let unlinearised = <Green as Surrogate<MONITORS, CORRECTORS, SUPPLIES, PARAMS>>::UNLINEARISED;
    let (mut linearised, mut prediction) = (Box::new(unlinearised), Box::new(Prediction::BLANK));
    linearise(&tables, &mut linearised);
    tables.predict(&linearised, &drive, &mut prediction);
    (tables, linearised, drive, prediction)
}

fn linearise(tables: &Green, linearised: &mut Linearised) {
    let params: [f32; PARAMS] = core::array::from_fn(|i| 0.03 * (1.7 * i as f32).sin());
    Surrogate::<MONITORS, CORRECTORS, SUPPLIES, PARAMS>::linearise(
        tables,
        black_box(&params),
        &[0.0; SUPPLIES],
        linearised,
    )
    .unwrap();
}

/// The surrogate at new gradients.
#[divan::bench]
fn linearisation(bencher: Bencher) {
    let (tables, mut linearised, ..) = predicted();
    bencher.bench_local(|| linearise(&tables, &mut linearised));
}

/// Orbit at 33 monitors and its derivative by 48 params.
#[divan::bench]
fn predict(bencher: Bencher) {
    let (tables, linearised, drive, mut prediction) = predicted();
    bencher.bench_local(|| tables.predict(black_box(&linearised), &drive, &mut prediction));
}

const PRIOR: Prior = Prior { mean: 0.0, sigma: 0.03, lower: -0.06, upper: 0.06 };

type Posterior = Gaussian<CHANNELS, PARAMS, TRIANGLE, Correlated<CHANNELS, COUPLINGS>>;

fn prior() -> Box<Posterior> {
    let mut gaussian = Box::new(Gaussian::BLANK);
    gaussian.reset(|_| PRIOR, |_| 0.02);
    gaussian
}

/// A frame's 33 readings enter the Gaussian.
fn condition_all(gaussian: &mut Posterior, prediction: &Prediction) {
    let slopes = prediction.jacobian.as_slice().chunks_exact(PARAMS).enumerate();
    let reading = |(channel, slope)| Reading { channel, innovation: black_box(1e-3), variance: 2.25e-8, slope };
    gaussian.condition(slopes.map(reading), &|_| 0.0);
}

/// All readings of a frame, 33 updates of the Gaussian.
#[divan::bench]
fn condition(bencher: Bencher) {
    let (.., prediction) = predicted();
    let mut gaussian = prior();
    bencher.bench_local(|| condition_all(&mut gaussian, &prediction));
}

/// Best point, error bars and evidence of 48 params.
#[divan::bench]
fn solve(bencher: Bencher) {
    let (.., prediction) = predicted();
    let (mut gaussian, mut solution) = (prior(), Box::new(Solution::<PARAMS, TRIANGLE, WORDS>::BLANK));
    condition_all(&mut gaussian, &prediction);
    bencher.bench_local(|| assert!(solution.solve(black_box(&gaussian), |_| PRIOR)));
}

/// The surrogate's tables from the twin.
#[divan::bench]
fn tables(bencher: Bencher) {
    let ring = Ring::booster();
    bencher.bench_local(|| training::green::tables(black_box(&ring)).unwrap());
}
