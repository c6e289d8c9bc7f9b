//! The covariance of the params, apart from the core.

/// How far the params are spread after a frame: a copy of what their covariance is made of, which is made in a hundredth of the time that
/// the covariance takes.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Spread(pub(super) Vec<f64>);

impl Spread {
    /// Covariance of the params `theta = ln var`, the same bits as [`super::Core::covariance`]: its lower triangle row by row, `(0,0) (1,0)
    /// (1,1) (2,0) ..`. Params that the core has room for beyond the ring's come after them.
    pub fn covariance(mut self) -> Vec<f32> {
        estimator::square(&mut self.0);
        // a sum that begins at 0 is never -0
        self.0.iter().map(|entry| (entry + 0.0) as f32).collect()
    }
}
