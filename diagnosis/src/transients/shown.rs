//! What a transient shows in single frames.

/// One reading of a frame, after a change or of a corrector that is unsteady.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shown {
    /// Predicted difference [m], per unit of the amplitude of a cause that has one.
    pub predicted: f64,
    /// The difference [m].
    pub measured: f64,
    /// Its noise [m].
    pub sigma: f64,
}
