//! The published network in f32: two hidden layers of 400, each inside a skip connection, on a first layer of 400.
//!
//! `h1 = s(W1 x + b1)`, `h2 = h1 + s(W2 h1 + b2)`, `h3 = h2 + s(W3 h2 + b3)`, `y = W4 h3 + b4`.
//!
//! `s` is a ReLU whose corner is a parabola: its derivative rises evenly from 0 at -1 to 1 at 1. It has a continuous Jacobian, and
//! costs a product.
//!
//! Numbers: 77 x 400 + 400 + 2 (400 x 400 + 400) + 400 x 15 + 15 = 358,015 in x, 359,218 in y; the paper says some 360,000.
//!
//! Many samples at once, a column each. Source: K. He et al., Deep Residual Learning (2016); D. Rumelhart et al., Nature 323 (1986) 533.

use estimator::surrogate::{HIDDEN, LAYERS, smooth, smooth_slope};
use nalgebra::{DMatrix, DMatrixView, DVector, Dyn, Matrix, ViewStorage};
use rand::RngExt;
use rand::rngs::StdRng;
use rand_distr::{Distribution, StandardNormal};

/// One layer.
#[derive(Debug, Clone, PartialEq)]
pub struct Layer {
    /// Rows outputs, columns inputs.
    pub weight: DMatrix<f32>,
    /// One an output.
    pub bias: DVector<f32>,
}

impl Layer {
    /// All zero.
    pub fn zeros(outputs: usize, inputs: usize) -> Self {
        Self { weight: DMatrix::zeros(outputs, inputs), bias: DVector::zeros(outputs) }
    }

    /// Numbers in it.
    pub fn len(&self) -> usize {
        self.weight.len() + self.bias.len()
    }

    /// True if it has none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The network, or a derivative with respect to each of its numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Network {
    /// First to last.
    pub layers: [Layer; LAYERS],
}

impl Network {
    /// All zero.
    pub fn zeros(inputs: usize, outputs: usize) -> Self {
        let sizes = [(HIDDEN, inputs), (HIDDEN, HIDDEN), (HIDDEN, HIDDEN), (outputs, HIDDEN)];
        Self { layers: sizes.map(|(outputs, inputs)| Layer::zeros(outputs, inputs)) }
    }

    /// Random weights whose sums have a variance of 2 in the first layer, 1 in the hidden ones, 0.1 in the last.
    pub fn random(inputs: usize, outputs: usize, random: &mut StdRng) -> Self {
        let mut network = Self::zeros(inputs, outputs);
        for (layer, variance) in network.layers.iter_mut().zip([1.0, 1.0, 1.0, 0.1]) {
            let sigma = (variance / layer.weight.ncols() as f32).sqrt();
            let mut normal = || -> f32 { StandardNormal.sample(random) };
            layer.weight.apply(|weight| *weight = sigma * normal());
            layer.bias.apply(|bias| *bias = 0.0);
        }
        for bias in network.layers[..3].iter_mut().flat_map(|layer| layer.bias.iter_mut()) {
            *bias = random.random_range(-0.5..0.5);
        }
        network
    }

    /// Numbers in it.
    pub fn len(&self) -> usize {
        self.layers.iter().map(Layer::len).sum()
    }

    /// True if it has none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// All numbers: weights and biases of each layer.
    pub fn slices(&self) -> impl Iterator<Item = &[f32]> {
        self.layers.iter().flat_map(|layer| [layer.weight.as_slice(), layer.bias.as_slice()])
    }

    /// All numbers, to be changed.
    pub fn slices_mut(&mut self) -> impl Iterator<Item = &mut [f32]> {
        self.layers.iter_mut().flat_map(|layer| [layer.weight.as_mut_slice(), layer.bias.as_mut_slice()])
    }
}

/// What a batch leaves in the layers on its way forward, and its derivatives on the way back.
#[derive(Debug, Clone)]
pub struct Pass {
    /// Sums before `s` of the first three layers, then the outputs.
    pub sums: [DMatrix<f32>; LAYERS],
    /// `h1, h2, h3`.
    hidden: [DMatrix<f32>; 3],
    back: DMatrix<f32>,
    slope: DMatrix<f32>,
}

impl Pass {
    /// Room for a batch.
    ///
    /// # Panics
    /// For fewer than six samples, inputs or outputs: nalgebra then multiplies by a loop of its own, which takes no transposed views.
    pub fn new(network: &Network, batch: usize) -> Self {
        let [first, .., last] = &network.layers;
        let sizes = [batch, first.weight.ncols(), last.weight.nrows()];
        assert!(sizes.iter().all(|size| *size > 5), "samples, inputs and outputs {sizes:?}: fewer than six");
        let matrix = |layer: &Layer| DMatrix::zeros(layer.weight.nrows(), batch);
        let hidden = || DMatrix::zeros(HIDDEN, batch);
        Self {
            sums: network.layers.each_ref().map(matrix),
            hidden: [hidden(), hidden(), hidden()],
            back: hidden(),
            slope: hidden(),
        }
    }

    /// The outputs of [`Pass::forward`].
    pub fn outputs(&self) -> &DMatrix<f32> {
        &self.sums[LAYERS - 1]
    }

    /// The outputs, a column a sample.
    pub fn forward(&mut self, network: &Network, inputs: &DMatrixView<f32>) -> &DMatrix<f32> {
        for (l, layer) in network.layers.iter().enumerate() {
            let sum = &mut self.sums[l];
            sum.column_iter_mut().for_each(|mut column| column.copy_from(&layer.bias));
            match l {
                0 => sum.gemm(1.0, &layer.weight, inputs, 1.0),
                _ => sum.gemm(1.0, &layer.weight, &self.hidden[l - 1], 1.0),
            }
            if l == LAYERS - 1 {
                break;
            }
            let (before, after) = self.hidden.split_at_mut(l);
            let to = after[0].as_mut_slice();
            match before.last() {
                None => to.iter_mut().zip(sum.as_slice()).for_each(|(h, z)| *h = smooth(*z)),
                Some(before) => {
                    let each = to.iter_mut().zip(sum.as_slice()).zip(before.as_slice());
                    each.for_each(|((h, z), before)| *h = before + smooth(*z));
                }
            }
        }
        &self.sums[LAYERS - 1]
    }

    /// The derivative with respect to every number of the network, after [`Pass::forward`] of the same inputs, from that with
    /// respect to the outputs.
    pub fn backward(
        &mut self,
        network: &Network,
        inputs: &DMatrixView<f32>,
        by_output: &DMatrix<f32>,
        into: &mut Network,
    ) {
        for l in (0..LAYERS).rev() {
            let layer = &network.layers[l];
            let is_last = l == LAYERS - 1;
            if !is_last {
                let each = self.slope.as_mut_slice().iter_mut().zip(self.back.as_slice()).zip(self.sums[l].as_slice());
                each.for_each(|((slope, back), z)| *slope = back * smooth_slope(*z));
            }
            let slope = if is_last { by_output } else { &self.slope };
            let to = &mut into.layers[l];
            match l {
                0 => to.weight.gemm(1.0, slope, &inputs.transpose(), 0.0),
                _ => to.weight.gemm(1.0, slope, &transposed(&self.hidden[l - 1]), 0.0),
            }
            to.bias.fill(0.0);
            slope.column_iter().for_each(|column| to.bias += column);
            if l > 0 {
                let keep = if is_last { 0.0 } else { 1.0 };
                self.back.gemm(1.0, &transposed(&layer.weight), slope, keep);
            }
        }
    }

    /// The derivative with respect to every input, sample by sample, after [`Pass::forward`], from that with respect to the outputs.
    pub fn input_slopes(&self, network: &Network, by_output: &DMatrix<f32>) -> DMatrix<f32> {
        let [first, second, third, last] = &network.layers;
        let mut back = transposed(&last.weight) * by_output;
        for (layer, sums) in [(third, &self.sums[2]), (second, &self.sums[1])] {
            let slope = back.zip_map(sums, |back, z| back * smooth_slope(z));
            back.gemm(1.0, &transposed(&layer.weight), &slope, 1.0);
        }
        transposed(&first.weight) * back.zip_map(&self.sums[0], |back, z| back * smooth_slope(z))
    }
}

pub(super) type Transposed<'a> = Matrix<f32, Dyn, Dyn, ViewStorage<'a, f32, Dyn, Dyn, Dyn, Dyn>>;

/// The transpose, without moving a number.
pub(super) fn transposed(matrix: &DMatrix<f32>) -> Transposed<'_> {
    let (rows, columns) = matrix.shape();
    let (shape, strides) = ((Dyn(columns), Dyn(rows)), (Dyn(rows), Dyn(1)));
    Transposed::from_slice_with_strides_generic(matrix.as_slice(), shape.0, shape.1, strides.0, strides.1)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::super::fit::columns;
    use super::*;

    /// Eight samples of seven inputs and six outputs.
    fn example() -> (Network, DMatrix<f32>, DMatrix<f32>) {
        let network = Network::random(7, 6, &mut StdRng::seed_from_u64(3));
        let inputs = DMatrix::from_fn(7, 8, |i, j| (2.3 * i as f32 + 1.1 * j as f32).sin());
        let weights = DMatrix::from_fn(6, 8, |i, j| (1.7 * i as f32 + 0.9 * j as f32).cos());
        (network, inputs, weights)
    }

    /// A function of the outputs.
    fn value(network: &Network, inputs: &DMatrix<f32>, weights: &DMatrix<f32>) -> f64 {
        let outputs = Pass::new(network, 8).forward(network, &columns(inputs, 0, 8)).clone();
        outputs.iter().zip(weights).map(|(output, weight)| f64::from(output * weight)).sum()
    }

    /// Central differences in a step of 0.01: rounding of f32 over it, and the second order of `s`.
    #[test]
    fn derivatives_are_those_of_the_outputs() {
        let (network, inputs, weights) = example();
        let mut pass = Pass::new(&network, 8);
        pass.forward(&network, &columns(&inputs, 0, 8));
        let mut slopes = network.clone();
        pass.backward(&network, &columns(&inputs, 0, 8), &weights, &mut slopes);
        let step = 0.01;
        for l in 0..LAYERS {
            let largest = slopes.layers[l].weight.amax();
            for at in (0..network.layers[l].weight.len()).step_by(977).chain([0]) {
                let moved = |by: f32| {
                    let mut network = network.clone();
                    network.layers[l].weight.as_mut_slice()[at] += by;
                    value(&network, &inputs, &weights)
                };
                let difference = (moved(step) - moved(-step)) / f64::from(2.0 * step);
                let slope = slopes.layers[l].weight.as_slice()[at];
                assert!(
                    (f64::from(slope) - difference).abs() < 2e-3 * f64::from(largest),
                    "{l} {at}: {slope} {difference}"
                );
            }
        }
        let by_input = pass.input_slopes(&network, &weights);
        for at in 0..inputs.len() {
            let moved = |by: f32| {
                let mut inputs = inputs.clone();
                inputs[at] += by;
                value(&network, &inputs, &weights)
            };
            let difference = (moved(step) - moved(-step)) / f64::from(2.0 * step);
            let miss = (f64::from(by_input[at]) - difference).abs();
            assert!(miss < 5e-3 * f64::from(by_input.amax()), "{at}: {} {difference}", by_input[at]);
        }
    }

    #[test]
    fn the_numbers_are_those_of_the_published_network() {
        assert_eq!([Network::zeros(77, 15).len(), Network::zeros(77, 18).len()], [358_015, 359_218]);
    }
}
