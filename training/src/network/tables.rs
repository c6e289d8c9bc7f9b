//! The network in 8-bit codes: the bytes that a core reads, see [`estimator::surrogate::Network::new`].

use estimator::surrogate::{HIDDEN, LARGEST, LAYERS, Network as Core, ORBIT, Pass as CorePass, Plain, smooth};

use super::fit::{columns, steps};
use super::layers::{Network, Pass};
use super::samples::{Samples, Source};

/// Largest input that has a code: vars reach 1.73 within the range of the training, the corrector that is set 5.
const INPUT: f32 = 8.0;
/// Room above the largest value of a layer among the samples.
const HEADROOM: f32 = 1.5;

/// Tables of a plane, whose weights are multiples of their steps; what hidden layers reach, and the error that is stated, are those
/// of some samples.
pub fn bytes(source: &Source, plane: usize, network: &Network, samples: &Samples) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut put = |number: f32| bytes.extend(number.to_le_bytes());
    input_steps(network, samples).into_iter().for_each(&mut put);
    put(0.0); // the stated error, known once there is a core
    let design = source.design_orbits(plane);
    design.iter().for_each(|orbit| put(*orbit as f32));
    for layer in &network.layers {
        let steps = steps(layer);
        for (row, step) in layer.weight.row_iter().zip(&steps) {
            bytes.extend(row.iter().map(|weight| (weight / step).round() as i8 as u8));
        }
        steps.iter().chain(&layer.bias).for_each(|number| bytes.extend(number.to_le_bytes()));
    }
    let stated = rms(&errors(source, plane, &bytes, samples)) * ORBIT;
    bytes[4 * LAYERS..4 * (LAYERS + 1)].copy_from_slice(&stated.to_le_bytes());
    bytes
}

/// The network of a core, with its 8-bit weights as they are.
pub fn network(core: &Core<'_>) -> Network {
    let (inputs, outputs) = core.shape();
    let mut network = Network::zeros(inputs, outputs);
    for (l, layer) in network.layers.iter_mut().enumerate() {
        for (o, (codes, step, bias)) in core.rows(l).enumerate() {
            layer.bias[o] = bias;
            let values = codes.iter().map(|code| step * f32::from(*code as i8));
            layer.weight.row_mut(o).iter_mut().zip(values).for_each(|(to, value)| *to = value);
        }
    }
    network
}

/// A core's network of these bytes.
pub fn core<'t>(source: &Source, plane: usize, bytes: &'t [u8]) -> Core<'t> {
    Core::new(bytes, source.inputs(plane), source.monitors(plane).len(), source.correctors(plane).len())
}

/// Errors of a core of these bytes, output by output, sample by sample [mm].
pub fn errors(source: &Source, plane: usize, bytes: &[u8], samples: &Samples) -> Vec<f32> {
    let core = core(source, plane, bytes);
    let mut pass = Box::new(CorePass::BLANK);
    let mut outputs = vec![0.0; samples.targets.nrows()];
    let mut errors = Vec::new();
    for (inputs, targets) in samples.inputs.column_iter().zip(samples.targets.column_iter()) {
        core.forward::<Plain>(inputs.as_slice(), &mut pass, &mut outputs);
        errors.extend(outputs.iter().zip(&targets).map(|(output, target)| output - target));
    }
    errors
}

/// Root of the mean square.
pub fn rms(values: &[f32]) -> f32 {
    let squares: f64 = values.iter().map(|v| f64::from(*v).powi(2)).sum();
    (squares / values.len().max(1) as f64).sqrt() as f32
}

/// Step of what each layer is given.
fn input_steps(network: &Network, samples: &Samples) -> [f32; LAYERS] {
    let mut pass = Pass::new(network, samples.inputs.ncols());
    pass.forward(network, &columns(&samples.inputs, 0, samples.inputs.ncols()));
    let mut largest = [INPUT, 0.0, 0.0, 0.0];
    for sample in 0..samples.inputs.ncols() {
        for unit in 0..HIDDEN {
            let mut value = 0.0;
            for (largest, sums) in largest[1..].iter_mut().zip(&pass.sums) {
                value += smooth(sums[(unit, sample)]);
                *largest = largest.max(HEADROOM * value);
            }
        }
    }
    largest.map(|largest| largest / LARGEST)
}
