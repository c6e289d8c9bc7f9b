//! The published network with int8 weights: one orbit of one corrector in one plane.
//!
//! `h1 = s(W1 x + b1)`, `h2 = h1 + s(W2 h1 + b2)`, `h3 = h2 + s(W3 h2 + b3)`, `y = W4 h3 + b4`: two hidden layers of 400, each inside
//! a skip connection. `s` is a ReLU whose corner is a parabola: its derivative rises evenly from 0 at -1 to 1 at 1.
//!
//! Weights are 8-bit codes with a step for each output, what they multiply is rounded to 16 bits with a step for each layer, and the
//! products are summed as integers: at most `400 x 127 x 32767 < 2^31`. What is left of a layer is one product and one sum in f32 for
//! each output, so that all targets agree to the bit.
//!
//! The Jacobian goes backwards through the same codes, a pass for each output: `g <- g + W^T (g s'(z))`, `g s'(z)` times the steps
//! rounded to 16 bits again.
//!
//! Source: K. He et al., Deep Residual Learning for Image Recognition (2016); B. Jacob et al., Quantization and Training of Neural
//! Networks (2018), for the integers.

use crc::{CRC_32_ISO_HDLC, Crc};

/// Outputs of a hidden layer, and the most that any layer has inputs.
pub const HIDDEN: usize = 400;
/// Layers.
pub const LAYERS: usize = 4;
/// Inputs at which targets are compared.
pub const SAMPLES: usize = 2;
static CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
/// Largest code of what weights multiply: 16 bits.
pub const LARGEST: f32 = 32_767.0;

/// Sum of products of codes: the one inner loop of the network. A chip may have an instruction for two products at once; the sum
/// is an integer, and the same however it is made.
pub trait Products {
    /// `sum of weights[i] codes[i]`, as long as the shorter of both; bytes are signed.
    fn sum(weights: &[u8], codes: &[i16]) -> i32;
}

/// [`Products`] as the compiler makes them.
#[derive(Debug, Clone, Copy)]
pub struct Plain;

impl Products for Plain {
    fn sum(weights: &[u8], codes: &[i16]) -> i32 {
        weights.iter().zip(codes).map(|(weight, code)| i32::from(*weight as i8) * i32::from(*code)).sum()
    }
}

/// One layer, in the bytes of the tables.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Layer<'t> {
    /// Codes of the weights, output by output.
    weights: &'t [u8],
    /// Step of each output's weights, then each output's bias.
    numbers: &'t [u8],
    inputs: usize,
}

/// The network of one plane: tables that stay where they are, in flash or in the program.
///
/// `correctors` inputs of 5 times a corrector's current over its setting, 5 magnet currents, 48 vars; outputs of 1 mm, beyond the orbit
/// that the design has.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Network<'t> {
    layers: [Layer<'t>; LAYERS],
    /// Step of the codes that a layer is given.
    steps: [f32; LAYERS],
    /// Orbit of the design for the setting of each corrector [m], f32, corrector by corrector.
    design: &'t [u8],
    /// Stated rms error of the orbit of one setting [m].
    stated_error: f32,
    inputs: usize,
    outputs: usize,
}

/// What a layer leaves on the way forward, and the work space of all.
#[derive(Debug, Clone)]
pub struct Pass {
    /// What was put in, then each layer's outputs.
    values: [f32; HIDDEN],
    /// The same in codes.
    codes: [i16; HIDDEN],
    /// `s'` of each layer but the last.
    slopes: [[f32; HIDDEN]; LAYERS - 1],
    /// Integer sums on the way back.
    sums: [i32; HIDDEN],
}

impl<'t> Network<'t> {
    /// Bytes of the tables of one plane.
    pub const fn bytes(inputs: usize, outputs: usize, correctors: usize) -> usize {
        let weights = HIDDEN * (inputs + 2 * HIDDEN + outputs);
        weights + 8 * (3 * HIDDEN + outputs) + 4 * (LAYERS + 1) + 4 * correctors * outputs
    }

    /// Tables of a plane: the steps of the four layers' inputs, the stated error [m], the design's orbits [m], then for each layer its
    /// weights, steps and biases; little endian.
    ///
    /// # Panics
    /// If there are not as many bytes as that takes.
    pub const fn new(bytes: &'t [u8], inputs: usize, outputs: usize, correctors: usize) -> Self {
        assert!(bytes.len() == Self::bytes(inputs, outputs, correctors), "tables of another network");
        assert!(inputs <= HIDDEN && outputs <= HIDDEN, "no layer is wider than the hidden ones");
        let (steps, rest) = bytes.split_at(4 * LAYERS);
        let (stated_error, rest) = rest.split_at(4);
        let (design, rest) = rest.split_at(4 * correctors * outputs);
        let (first, rest) = Layer::take(rest, inputs, HIDDEN);
        let (second, rest) = Layer::take(rest, HIDDEN, HIDDEN);
        let (third, rest) = Layer::take(rest, HIDDEN, HIDDEN);
        let (last, _) = Layer::take(rest, HIDDEN, outputs);
        Self {
            layers: [first, second, third, last],
            steps: [number(steps, 0), number(steps, 1), number(steps, 2), number(steps, 3)],
            design,
            stated_error: number(stated_error, 0),
            inputs,
            outputs,
        }
    }

    /// Stated rms error of the orbit of one setting [m].
    pub const fn stated_error(&self) -> f32 {
        self.stated_error
    }

    /// Numbers that were trained.
    pub const fn parameters(&self) -> usize {
        HIDDEN * (self.inputs + 2 * HIDDEN + self.outputs) + 3 * HIDDEN + self.outputs
    }

    /// CRC-32 (ISO-HDLC) of outputs and Jacobians at [`SAMPLES`] fixed inputs, in f32, little endian: what every target arrives at.
    pub fn digest<P: Products>(&self, pass: &mut Pass) -> u32 {
        let mut digest = CRC.digest();
        let (mut inputs, mut outputs) = ([0.0; HIDDEN], [0.0; HIDDEN]);
        for sample in 0..SAMPLES {
            // spread over -1.73 to 1.73 in no order
            let spread = |i: usize| 1.73 * (((37 * (i + 101 * sample)) % 103) as f32 / 51.0 - 1.0);
            inputs.iter_mut().enumerate().for_each(|(i, input)| *input = spread(i));
            self.forward::<P>(&inputs, pass, &mut outputs);
            outputs.iter().take(self.outputs).for_each(|output| digest.update(&output.to_le_bytes()));
            for output in 0..self.outputs {
                self.back(output, pass, &mut inputs);
                inputs.iter().take(self.inputs).for_each(|slope| digest.update(&slope.to_le_bytes()));
            }
        }
        digest.finalize()
    }

    /// Codes of the weights, step and bias of each output of a layer.
    pub fn rows(&self, layer: usize) -> impl Iterator<Item = (&'t [u8], f32, f32)> {
        self.layers.get(layer).into_iter().flat_map(Layer::rows)
    }

    /// Inputs and outputs.
    pub const fn shape(&self) -> (usize, usize) {
        (self.inputs, self.outputs)
    }

    /// Orbit of the design for the setting of a corrector at a monitor [m].
    pub fn design(&self, corrector: usize, monitor: usize) -> f32 {
        number(self.design, corrector * self.outputs + monitor)
    }

    /// The outputs [mm], and what [`Network::back`] needs.
    #[inline(never)]
    pub fn forward<P: Products>(&self, inputs: &[f32], pass: &mut Pass, outputs: &mut [f32]) {
        pass.values.iter_mut().zip(inputs).for_each(|(to, from)| *to = *from);
        for (l, (layer, step)) in self.layers.iter().zip(self.steps).enumerate() {
            let (values, codes) = (&pass.values, &mut pass.codes);
            let length = layer.inputs.min(HIDDEN);
            codes.iter_mut().zip(values).take(length).for_each(|(code, value)| *code = nearest(*value / step));
            let codes = codes.get(..length).unwrap_or_default();
            let sums = layer.rows().map(|(weights, scale, bias)| scale * step * P::sum(weights, codes) as f32 + bias);
            match pass.slopes.get_mut(l) {
                None => outputs.iter_mut().zip(sums).for_each(|(to, sum)| *to = sum),
                Some(slopes) => {
                    for ((value, slope), sum) in pass.values.iter_mut().zip(slopes).zip(sums) {
                        let before = if l == 0 { 0.0 } else { *value };
                        *value = before + smooth(sum);
                        *slope = smooth_slope(sum);
                    }
                }
            }
        }
    }

    /// The derivative of an output with respect to every input, after [`Network::forward`].
    #[inline(never)]
    pub fn back(&self, output: usize, pass: &mut Pass, by_input: &mut [f32]) {
        let [first, second, third, last] = &self.layers;
        let (values, sums) = (&mut pass.values, &mut pass.sums);
        let Some((weights, scale, _)) = last.rows().nth(output) else { return };
        values.iter_mut().zip(weights).for_each(|(g, weight)| *g = scale * f32::from(*weight as i8));
        for (layer, slopes) in [(third, &pass.slopes[2]), (second, &pass.slopes[1])] {
            let step = layer.transpose(values, slopes, &mut pass.codes, sums);
            values.iter_mut().zip(sums.iter()).for_each(|(g, sum)| *g += step * *sum as f32);
        }
        let step = first.transpose(values, &pass.slopes[0], &mut pass.codes, sums);
        by_input.iter_mut().zip(sums.iter()).for_each(|(g, sum)| *g = step * *sum as f32);
    }
}

impl Pass {
    /// Work space, all zero.
    pub const BLANK: Self =
        Self { values: [0.0; HIDDEN], codes: [0; HIDDEN], slopes: [[0.0; HIDDEN]; LAYERS - 1], sums: [0; HIDDEN] };
}

impl<'t> Layer<'t> {
    /// The layer at the front, and what comes after it.
    const fn take(bytes: &'t [u8], inputs: usize, outputs: usize) -> (Self, &'t [u8]) {
        let (weights, rest) = bytes.split_at(inputs * outputs);
        let (numbers, rest) = rest.split_at(8 * outputs);
        (Self { weights, numbers, inputs }, rest)
    }

    /// Weights, step and bias of each output.
    fn rows(&self) -> impl Iterator<Item = (&'t [u8], f32, f32)> + use<'t> {
        let outputs = self.numbers.len() / 8;
        let (steps, biases) = self.numbers.split_at(4 * outputs);
        let each = steps.as_chunks::<4>().0.iter().zip(biases.as_chunks::<4>().0);
        let numbers = each.map(|(step, bias)| (f32::from_le_bytes(*step), f32::from_le_bytes(*bias)));
        self.weights.chunks_exact(self.inputs.max(1)).zip(numbers).map(|(weights, (step, bias))| (weights, step, bias))
    }

    /// `W^T (g slopes)` in steps, and the size of a step.
    fn transpose(
        &self,
        g: &[f32; HIDDEN],
        slopes: &[f32; HIDDEN],
        codes: &mut [i16; HIDDEN],
        sums: &mut [i32; HIDDEN],
    ) -> f32 {
        let scaled = || self.rows().zip(g.iter().zip(slopes)).map(|((_, step, _), (g, slope))| g * slope * step);
        let step = (scaled().fold(0.0, |largest: f32, v| largest.max(v.abs())) / LARGEST).max(f32::MIN_POSITIVE);
        codes.iter_mut().zip(scaled()).for_each(|(code, v)| *code = nearest(v / step));
        sums.fill(0);
        for ((weights, ..), code) in self.rows().zip(codes.iter()) {
            // units that are off pass nothing on
            if *code != 0 {
                add(sums, i32::from(*code), weights);
            }
        }
        step
    }
}

/// `sums += code weights`.
#[inline(never)]
fn add(sums: &mut [i32; HIDDEN], code: i32, weights: &[u8]) {
    sums.iter_mut().zip(weights).for_each(|(sum, weight)| *sum += code * i32::from(*weight as i8));
}

/// The `i`-th f32 of some bytes.
const fn number(bytes: &[u8], i: usize) -> f32 {
    f32::from_le_bytes([bytes[4 * i], bytes[4 * i + 1], bytes[4 * i + 2], bytes[4 * i + 3]])
}

/// The code nearest to a value, the largest where it is beyond.
fn nearest(value: f32) -> i16 {
    (value + if value < 0.0 { -0.5 } else { 0.5 }) as i16
}

/// `s(z)`, of the network's units.
pub fn smooth(z: f32) -> f32 {
    let t = z.clamp(-1.0, 1.0) + 1.0;
    0.25 * t * t + (z - 1.0).max(0.0)
}

/// Its derivative.
pub fn smooth_slope(z: f32) -> f32 {
    0.5 * (z.clamp(-1.0, 1.0) + 1.0)
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::vec::Vec;

    use super::*;

    /// Eight inputs, four outputs, two correctors.
    const SHAPE: (usize, usize, usize) = (8, 4, 2);

    /// Tables of a random network.
    fn bytes() -> Vec<u8> {
        let (inputs, outputs, correctors) = SHAPE;
        let mut state = 1_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        };
        let mut bytes = Vec::new();
        for number in [8.0, 20.0, 40.0, 60.0].map(|largest| largest / LARGEST).into_iter().chain([1e-4]) {
            bytes.extend(number.to_le_bytes());
        }
        (0..correctors * outputs).for_each(|_| bytes.extend((1e-3 * random()).to_le_bytes()));
        for (inputs, outputs) in [(inputs, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, outputs)] {
            (0..inputs * outputs).for_each(|_| bytes.push((127.0 * random()) as i8 as u8));
            (0..outputs).for_each(|_| bytes.extend((0.02 / libm::sqrtf(inputs as f32)).to_le_bytes()));
            (0..outputs).for_each(|_| bytes.extend((0.5 * random()).to_le_bytes()));
        }
        bytes
    }

    /// The same in f64 without any rounding but that of the weights.
    fn exact(network: &Network<'_>, inputs: &[f64]) -> Vec<f64> {
        let mut values = inputs.to_vec();
        for layer in 0..LAYERS {
            let sum = |(weights, step, bias): (&[u8], f32, f32)| {
                let products = weights.iter().zip(&values).map(|(w, v)| f64::from(*w as i8) * v);
                f64::from(step) * products.sum::<f64>() + f64::from(bias)
            };
            let smooth = |z: f64| 0.25 * (z.clamp(-1.0, 1.0) + 1.0).powi(2) + (z - 1.0).max(0.0);
            let sums: Vec<f64> = network.rows(layer).map(sum).collect();
            values = match layer {
                0 => sums.into_iter().map(smooth).collect(),
                1 | 2 => sums.into_iter().zip(&values).map(|(z, before)| before + smooth(z)).collect(),
                _ => sums,
            };
        }
        values
    }

    fn inputs() -> [f32; 8] {
        core::array::from_fn(|i| 1.5 * libm::sinf(2.3 * i as f32))
    }

    /// Rounding of what weights multiply: half a step in 32767 at each of 400 inputs of three layers.
    #[test]
    fn outputs_are_those_of_exact_arithmetic() {
        let bytes = bytes();
        let network = Network::new(&bytes, SHAPE.0, SHAPE.1, SHAPE.2);
        let mut outputs = [0.0; 4];
        network.forward::<Plain>(&inputs(), &mut Pass::BLANK.clone(), &mut outputs);
        let exact = exact(&network, &inputs().map(f64::from));
        let largest = exact.iter().fold(0.0, |l: f64, v| l.max(v.abs()));
        for (ours, exact) in outputs.iter().zip(&exact) {
            assert!((f64::from(*ours) - exact).abs() < 1e-3 * largest, "{outputs:?} {exact:?}");
        }
    }

    #[test]
    fn the_jacobian_is_that_of_exact_arithmetic() {
        let bytes = bytes();
        let network = Network::new(&bytes, SHAPE.0, SHAPE.1, SHAPE.2);
        let (mut pass, mut outputs, mut slopes) = (Pass::BLANK, [0.0; 4], [0.0; 8]);
        network.forward::<Plain>(&inputs(), &mut pass, &mut outputs);
        for output in 0..4 {
            network.back(output, &mut pass, &mut slopes);
            for input in 0..8 {
                let at = |step: f64| {
                    let mut inputs = inputs().map(f64::from);
                    inputs[input] += step;
                    exact(&network, &inputs)[output]
                };
                // fourth order in 1e-3; the slopes of `s` jump nowhere
                let h = 1e-3;
                let difference = (8.0 * (at(h) - at(-h)) - at(2.0 * h) + at(-2.0 * h)) / (12.0 * h);
                let largest = slopes.iter().fold(0.0, |l: f32, v| l.max(v.abs()));
                let miss = (f64::from(slopes[input]) - difference).abs();
                // 16 bits of what goes back, and slopes of units whose sum is rounded
                assert!(miss < 2e-3 * f64::from(largest), "{output} {input}: {} {difference}", slopes[input]);
            }
        }
    }

    /// As a chip with two products at once would sum: by fours, even ones first.
    #[test]
    fn the_order_of_the_products_does_not_matter() {
        struct Pairs;
        impl Products for Pairs {
            fn sum(weights: &[u8], codes: &[i16]) -> i32 {
                let product = |i: usize| i32::from(weights[i] as i8) * i32::from(codes[i]);
                let n = weights.len().min(codes.len());
                (0..n).step_by(2).map(product).sum::<i32>() + (1..n).step_by(2).map(product).sum::<i32>()
            }
        }
        let bytes = bytes();
        let network = Network::new(&bytes, SHAPE.0, SHAPE.1, SHAPE.2);
        let mut pass = Pass::BLANK;
        assert_eq!(network.digest::<Plain>(&mut pass), network.digest::<Pairs>(&mut pass));
    }

    #[test]
    fn no_sum_exceeds_32_bits() {
        const { assert!(HIDDEN as i64 * 127 * 32_768 < i32::MAX as i64) };
        assert_eq!(Plain::sum(&[127; HIDDEN], &[i16::MIN; HIDDEN]), -400 * 127 * 32_768);
    }
}
