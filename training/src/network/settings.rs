//! What the network is asked, each corrector of a plane at 22 A, and the response in its answers.

use estimator::surrogate::{CORRECTOR, CURRENTS, LAST_VAR, ORBIT, Pass, Plain, SETTING_KICK, SPAN};
use nalgebra::DMatrix;

use super::PLANES;

/// The input of a var.
pub fn of_var(var: f64) -> f32 {
    (var - 1.0) as f32 * (LAST_VAR / SPAN)
}

/// Inputs at vars `[N]`, a column for each corrector of a plane, with the magnets' currents at nominal.
pub fn settings(vars: &[f64]) -> DMatrix<f32> {
    let inputs = PLANES[0].shape().0;
    let correctors = inputs - CURRENTS - vars.len();
    DMatrix::from_fn(inputs, correctors, |row, column| match row.checked_sub(correctors + CURRENTS) {
        Some(var) => of_var(vars[var]),
        None if row == column => CORRECTOR,
        None => 0.0,
    })
}

/// Response of all monitors to all correctors [m/rad], by what each plane's network gives for the columns of [`settings`]; zero across the planes.
pub fn response(outputs: [&DMatrix<f32>; 2]) -> DMatrix<f64> {
    let (correctors, monitors) = (outputs[0].ncols(), outputs.map(|outputs| outputs.nrows()));
    let mut response = DMatrix::zeros(monitors[0] + monitors[1], 2 * correctors);
    for (plane, (network, outputs)) in PLANES.iter().zip(outputs).enumerate() {
        let own = DMatrix::from_fn(monitors[plane], correctors, |b, c| {
            f64::from((network.design(c, b) + ORBIT * outputs[(b, c)]) / SETTING_KICK)
        });
        response.view_mut((plane * monitors[0], plane * correctors), own.shape()).copy_from(&own);
    }
    response
}

/// The same by the networks of the core, in integers.
pub fn response_of_core(vars: &[f64]) -> DMatrix<f64> {
    let (inputs, mut pass) = (settings(vars), Pass::BLANK);
    let [x, y] = PLANES.each_ref().map(|network| {
        let mut outputs = DMatrix::zeros(network.shape().1, inputs.ncols());
        for (inputs, mut outputs) in inputs.column_iter().zip(outputs.column_iter_mut()) {
            network.forward::<Plain>(inputs.as_slice(), &mut pass, outputs.as_mut_slice());
        }
        outputs
    });
    response([&x, &y])
}
