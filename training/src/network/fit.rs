//! Training on the mean square error, batches of machines that no batch had before, then the same with rounded weights: Adam for the first and
//! the last layer and all biases, steps of the two hidden matrices with all singular values alike.
//!
//! The two planes are two networks, trained beside each other, one a core. A step is one batch; the step size rises over the first
//! 200, then falls as a cosine to zero. From [`Plan::rounded`] on the sums are those of weights rounded to 8 bits, and their
//! derivatives are taken for those of the weights themselves, with a cosine of their own.
//!
//! Source: D. Kingma and J. Ba, Adam (2015); K. Jordan et al., Muon: An optimizer for hidden layers in neural networks (2024); I. Loshchilov and F. Hutter, SGDR (2017), for the cosine; B. Jacob et al., Quantization and
//! Training of Neural Networks (2018), for rounding on the way forward.

use estimator::surrogate::ORBIT;
use nalgebra::{DMatrix, DMatrixView};
use rand::SeedableRng;
use rand::rngs::StdRng;

use super::layers::{Layer, Network, Pass, transposed};
use super::samples::{Samples, Source};

/// How long, and with what.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    /// Machines drawn at a time, each with all correctors once.
    pub machines: usize,
    /// Samples of a batch.
    pub batch: usize,
    /// Chunks of machines with weights as they are.
    pub free: usize,
    /// Chunks of machines with rounded weights, after that.
    pub rounded: usize,
    /// Largest step of both parts, over `STEP` and `TURN`.
    pub peak: [f64; 2],
    /// Everything random.
    pub seed: u64,
}

impl Plan {
    /// That of the committed tables.
    pub const FULL: Self = Self { machines: 1024, batch: 2048, free: 520, rounded: 90, peak: [1.0, 0.2], seed: 18 };

    /// All chunks.
    pub fn chunks(&self) -> usize {
        self.free + self.rounded
    }
}

/// Step of Adam.
const STEP: f64 = 2e-3;
/// Step of a hidden matrix.
const TURN: f64 = 0.02;
/// What is kept of the mean derivative at each step, and of the mean square; what keeps a step finite.
const MEAN: f32 = 0.9;
const SQUARE: f32 = 0.99;
const SMALL: f32 = 1e-8;
/// What is kept of the mean derivative of a hidden matrix.
const MEAN_OF_HIDDEN: f32 = 0.95;
/// Chunks from one validation to the next.
const EVERY: usize = 8;
/// Steps over which the step size rises.
const WARM_UP: f64 = 200.0;
/// Seed of the validation set, which no chunk of the training has.
const VALIDATION: u64 = 1 << 40;
/// Machines of the validation set: 5,016 samples.
const VALIDATION_MACHINES: usize = 209;

/// Errors after a chunk, rms of the difference of the orbits at 22 A and at -22 A [m].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Over the chunk that was learnt.
    pub training: f32,
    /// Over the validation set.
    pub validation: f32,
}

/// One plane, as far as it is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct Trainee {
    /// The network.
    pub network: Network,
    /// The network at the end of the part with free weights.
    pub free: Network,
    /// Running mean of the derivatives, and of their squares.
    pub moments: [Network; 2],
    /// Errors after each chunk so far.
    pub progress: Vec<Progress>,
}

impl Trainee {
    /// Untrained.
    pub fn new(source: &Source, plane: usize, plan: &Plan) -> Self {
        let (inputs, outputs) = (source.inputs(plane), source.monitors(plane).len());
        let network = Network::random(inputs, outputs, &mut StdRng::seed_from_u64(plan.seed + plane as u64));
        let zeros = Network::zeros(inputs, outputs);
        Self { free: network.clone(), network, moments: [zeros.clone(), zeros], progress: Vec::new() }
    }

    /// Learn one chunk.
    pub fn learn(&mut self, plan: &Plan, chunk: &[&Samples], validation: &Samples) {
        let done = self.progress.len();
        let is_rounded = done >= plan.free;
        let mut pass = Pass::new(&self.network, plan.batch);
        let mut slopes = self.network.clone();
        let each = |samples: &Samples| samples.inputs.ncols() / plan.batch;
        let batches: usize = chunk.iter().map(|samples| each(samples)).sum();
        let mut squares = 0.0;
        let all = chunk.iter().flat_map(|samples| (0..each(samples)).map(move |batch| (samples, batch)));
        for (step, (samples, batch)) in all.enumerate() {
            let inputs = columns(&samples.inputs, batch * plan.batch, plan.batch);
            let rounded = is_rounded.then(|| rounded(&self.network));
            let network = rounded.as_ref().unwrap_or(&self.network);
            let targets = columns(&samples.targets, batch * plan.batch, plan.batch);
            let mut errors = pass.forward(network, &inputs) - targets;
            squares += errors.norm_squared() / (batches * errors.len()) as f32;
            errors *= 2.0 / plan.batch as f32;
            pass.backward(network, &inputs, &errors, &mut slopes);
            self.step(plan, done * batches + step, batches, &slopes);
        }
        if done + 1 == plan.free {
            self.free = self.network.clone();
        }
        let training = 2.0 * ORBIT * squares.sqrt();
        let is_due = done.is_multiple_of(EVERY) || done + 1 == plan.free || done + 1 == plan.chunks();
        let validation = is_due.then(|| {
            let network = if is_rounded { rounded(&self.network) } else { self.network.clone() };
            validate(&network, validation)
        });
        self.progress.push(Progress { training, validation: validation.unwrap_or(f32::NAN) });
    }

    /// One step; `step` counts from the beginning.
    fn step(&mut self, plan: &Plan, step: usize, batches: usize, slopes: &Network) {
        let free = plan.free * batches;
        let (done, all, peak) = match step.checked_sub(free) {
            None => (step, free, plan.peak[0]),
            Some(done) => (done, plan.rounded * batches, plan.peak[1]),
        };
        let pace = peak * pace(done as f64, all as f64);
        let bias = |decay: f32| 1.0 - f64::from(decay).powi(step.min(1 << 20) as i32 + 1);
        let size = (STEP * pace * bias(SQUARE).sqrt() / bias(MEAN)) as f32;
        let [means, squares] = &mut self.moments;
        for (l, layer) in self.network.layers.iter_mut().enumerate() {
            let (slope, mean, square) = (&slopes.layers[l], &mut means.layers[l], &mut squares.layers[l]);
            if l == 1 || l == 2 {
                turn((TURN * pace) as f32, &mut layer.weight, &slope.weight, &mut mean.weight);
            } else {
                let moments = (mean.weight.as_mut_slice(), square.weight.as_mut_slice());
                adam(size, layer.weight.as_mut_slice(), slope.weight.as_slice(), moments);
            }
            let moments = (mean.bias.as_mut_slice(), square.bias.as_mut_slice());
            adam(size, layer.bias.as_mut_slice(), slope.bias.as_slice(), moments);
        }
    }
}

/// A step of Adam.
fn adam(size: f32, numbers: &mut [f32], slopes: &[f32], (means, squares): (&mut [f32], &mut [f32])) {
    for ((number, slope), (mean, square)) in numbers.iter_mut().zip(slopes).zip(means.iter_mut().zip(squares)) {
        *mean += (1.0 - MEAN) * (slope - *mean);
        *square += (1.0 - SQUARE) * (slope * slope - *square);
        *number -= size * *mean / (square.sqrt() + SMALL);
    }
}

/// A step of a hidden matrix: its mean derivative with all singular values made 1, so that no direction waits for the others.
fn turn(size: f32, weight: &mut DMatrix<f32>, slope: &DMatrix<f32>, mean: &mut DMatrix<f32>) {
    mean.zip_apply(slope, |mean, slope| *mean += (1.0 - MEAN_OF_HIDDEN) * (slope - *mean));
    let mut x = &*mean * MEAN_OF_HIDDEN + slope * (1.0 - MEAN_OF_HIDDEN);
    x /= x.norm() + SMALL;
    let (mut squares, mut odd) = (x.clone(), x.clone());
    // an odd polynomial that takes singular values from 0..1 to about 1, five times
    for _ in 0..5 {
        squares.gemm(1.0, &x, &transposed(&x), 0.0);
        odd.copy_from(&squares);
        odd.gemm(2.0315, &squares, &squares, -4.775);
        let before = x.clone();
        x.gemm(1.0, &odd, &before, 3.4445);
    }
    weight.zip_apply(&x, |weight, x| *weight -= size * x);
}

/// Step size over its peak.
fn pace(done: f64, all: f64) -> f64 {
    let warm_up = WARM_UP.min(0.1 * all);
    if done < warm_up {
        return (done + 1.0) / (warm_up + 1.0);
    }
    0.5 * (1.0 + (core::f64::consts::PI * (done - warm_up) / (all - warm_up)).cos())
}

/// The validation set of both planes: 5,016 samples each.
pub fn validation(source: &Source) -> [Samples; 2] {
    source.samples(VALIDATION_MACHINES, VALIDATION)
}

/// The machines of a chunk, drawn on two cores: two parts, each of both planes.
pub fn chunk(source: &Source, plan: &Plan, chunk: usize) -> [[Samples; 2]; 2] {
    // seeds of different plans differ in the upper half
    let seed = |part: u64| plan.seed << 21 | (chunk as u64) << 1 | part;
    std::thread::scope(|scope| {
        let other = scope.spawn(|| source.samples(plan.machines / 2, seed(1)));
        [source.samples(plan.machines / 2, seed(0)), other.join().expect("it draws samples")]
    })
}

/// Learn one chunk in both planes, one a core.
pub fn learn(source: &Source, plan: &Plan, planes: &mut [Trainee; 2], validation: &[Samples; 2]) {
    let parts = chunk(source, plan, planes[0].progress.len());
    let [x, y] = planes;
    std::thread::scope(|scope| {
        scope.spawn(|| x.learn(plan, &[&parts[0][0], &parts[1][0]], &validation[0]));
        y.learn(plan, &[&parts[0][1], &parts[1][1]], &validation[1]);
    });
}

/// Rms error of the difference of the orbits at 22 A and at -22 A: twice that of one [m].
pub fn validate(network: &Network, samples: &Samples) -> f32 {
    let mut pass = Pass::new(network, samples.inputs.ncols());
    let errors = pass.forward(network, &columns(&samples.inputs, 0, samples.inputs.ncols())) - &samples.targets;
    2.0 * ORBIT * (errors.norm_squared() / errors.len() as f32).sqrt()
}

/// Some columns.
pub fn columns(of: &DMatrix<f32>, from: usize, count: usize) -> DMatrixView<'_, f32> {
    let rows = of.nrows();
    DMatrixView::from_slice(&of.as_slice()[from * rows..(from + count) * rows], rows, count)
}

/// Largest code of 8 bits.
const LARGEST: f32 = 127.0;

/// Step of the codes of each output's weights.
pub fn steps(layer: &Layer) -> Vec<f32> {
    let mut largest = vec![f32::MIN_POSITIVE; layer.weight.nrows()];
    for column in layer.weight.column_iter() {
        largest.iter_mut().zip(&column).for_each(|(largest, weight)| *largest = largest.max(weight.abs()));
    }
    largest.iter().map(|largest| largest / LARGEST).collect()
}

/// The network with all weights rounded to 8 bits.
pub fn rounded(network: &Network) -> Network {
    let mut rounded = network.clone();
    for layer in &mut rounded.layers {
        let steps = steps(layer);
        for mut column in layer.weight.column_iter_mut() {
            column.iter_mut().zip(&steps).for_each(|(weight, step)| *weight = (*weight / step).round() * step);
        }
    }
    rounded
}
