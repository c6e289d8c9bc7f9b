//! A measurement with its cables put right, and its fit.
//!
//! The lattice as it is written down shows most wrong cables. Neighbours whose patterns differ by less than the errors of the strengths and of the
//! monitors' gains show only beside a fit, so each fit is asked again. What it says is exchanged counts where the next fit is the better for it.
//! Last, instruments are left out that read or kick nothing: what the model misses is not learnt from them.

use nalgebra::DMatrix;
use twin::median;

use crate::error::MeasuredError;
use crate::fit::{Fit, Settings, Start, fit};
use crate::folder::Folder;
use crate::model::Model;
use crate::unknowns::{Kind, groups};
use crate::wiring::{Wiring, exchanged_back, straightened};

/// A gain below this is that of a dead instrument.
pub const DEAD: f64 = 0.2;

/// A measurement with its cables put right, and its fit.
#[derive(Debug, Clone)]
pub struct Straightened {
    /// The measurement.
    pub folder: Folder,
    /// What was wrong.
    pub cables: Vec<Wiring>,
    /// Its fit.
    pub fit: Fit,
}

impl Straightened {
    /// Of a measurement as it was made; `progress` is told what is being done.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn of(
        as_measured: &Folder,
        settings: &Settings,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Self, MeasuredError> {
        let (folder, cables) = begun(as_measured, settings)?;
        let mut here = Self { fit: fit(&folder, settings, progress)?, folder, cables };
        while let Some(better) = here.once_more(settings, progress)? {
            here = better;
        }
        here.without_dead(settings, progress)
    }

    /// Without the instruments that the fit finds dead, which their cables may have been exchanged with.
    fn without_dead(mut self, settings: &Settings, progress: &mut dyn FnMut(&str)) -> Result<Self, MeasuredError> {
        let dead = self.fit.unknowns.iter().zip(&self.fit.values).filter(|(_, gain)| gain.abs() < DEAD);
        let (mut rows, mut columns) = (Vec::new(), Vec::new());
        for (unknown, _) in dead {
            match unknown.kind {
                Kind::MonitorGain(row) if self.folder.monitors[row].is_used => rows.push(row),
                Kind::CorrectorGain(column) if self.folder.correctors[column].is_used => columns.push(column),
                _ => {}
            }
        }
        let monitors = (!rows.is_empty()).then_some(Wiring::MonitorsDead(rows));
        let correctors = (!columns.is_empty()).then_some(Wiring::CorrectorsDead(columns));
        let dead: Vec<Wiring> = monitors.into_iter().chain(correctors).collect();
        if !self.fit.has_ended || dead.is_empty() {
            return Ok(self);
        }
        dead.iter().for_each(|one| one.put_right(&mut self.folder));
        self.fit = fit(&self.folder, settings, progress)?;
        self.cables.extend(dead);
        Ok(self)
    }

    /// With the cables that the fit shows to be exchanged put right, if there are any and the fit is the better for it.
    fn once_more(&self, settings: &Settings, progress: &mut dyn FnMut(&str)) -> Result<Option<Self>, MeasuredError> {
        // where the fit did not end its magnets are not those of the ring
        if !self.fit.has_ended {
            return Ok(None);
        }
        let (folder, more) = exchanged_back(&self.folder, &expected(&self.folder, &self.fit, settings)?);
        if more.is_empty() {
            return Ok(None);
        }
        let fit = fit(&folder, settings, progress)?;
        let cables = self.cables.iter().cloned().chain(more).collect();
        Ok((fit.chi2_loco < self.fit.chi2_loco).then_some(Self { folder, cables, fit }))
    }
}

/// The measurement is one that a fit begins with: a ring with a closed orbit, something to fit, elements that count, the unit of the lattice.
///
/// # Errors
/// [`MeasuredError`], as of [`Straightened::of`] before its first step.
pub fn expect_fit(as_measured: &Folder, settings: &Settings) -> Result<(), MeasuredError> {
    let (folder, _) = begun(as_measured, settings)?;
    Start::of(&folder, settings).map(drop)
}

/// With the cables put right that the lattice shows.
fn begun(as_measured: &Folder, settings: &Settings) -> Result<(Folder, Vec<Wiring>), MeasuredError> {
    let (folder, cables) = straightened(as_measured, settings)?;
    expect_unit(&folder, settings)?;
    Ok((folder, cables))
}

/// The matrix is about as large as that of the lattice as written: in another unit its instruments look dead.
fn expect_unit(folder: &Folder, settings: &Settings) -> Result<(), MeasuredError> {
    let written = Model::of(folder, &groups(folder), settings.rf)?.as_written()?;
    let counts = |&(i, j): &(usize, usize)| {
        let (monitor, corrector) = (&folder.monitors[i], &folder.correctors[j]);
        monitor.plane == corrector.plane && monitor.is_used && corrector.is_used && folder.matrix[(i, j)].is_finite()
    };
    let (rows, columns) = folder.matrix.shape();
    let elements: Vec<(usize, usize)> = (0..rows * columns).map(|k| (k % rows, k / rows)).filter(counts).collect();
    let size = |matrix: &DMatrix<f64>| median(elements.iter().map(|&at| matrix[at].abs())).unwrap_or_default();
    let [measured, expected] = [&folder.matrix, &written].map(size);
    // a dead measurement is said as such
    if measured == 0.0 || (DEAD * expected..expected / DEAD).contains(&measured) {
        return Ok(());
    }
    Err(MeasuredError::Convention(format!(
        "{}: elements of the matrix are {measured:.2e} mm, those of the lattice as written {expected:.2e} mm (medians of their sizes): the unit of \
         the matrix or of the kicks is another one",
        folder.name
    )))
}

/// What the instruments of a fit would measure, all with one sign [mm]: one that reads another's orbit may have a negative gain.
fn expected(folder: &Folder, fit: &Fit, settings: &Settings) -> Result<DMatrix<f64>, MeasuredError> {
    let mut values = fit.values.clone();
    for (unknown, value) in fit.unknowns.iter().zip(values.iter_mut()) {
        if matches!(unknown.kind, Kind::MonitorGain(_) | Kind::CorrectorGain(_)) {
            *value = value.abs();
        }
    }
    let model = Model::of(folder, &fit.groups, settings.rf)?;
    Ok(model.predict(&fit.unknowns, &values)?.matrix.columns(0, folder.correctors.len()).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{NOISE, machine, measured, normal, ring};

    fn of(folder: &Folder) -> Straightened {
        Straightened::of(folder, &Settings::default(), &mut |_| ()).unwrap()
    }

    #[test]
    fn dead_instruments_are_left_out() {
        let ring = ring();
        let mut folder = measured(&ring, &machine(&ring, 12), NOISE, 1);
        let mut normal = normal(5);
        folder.matrix.row_mut(7).iter_mut().for_each(|element| *element = 10.0 * NOISE * normal());
        folder.matrix.column_mut(20).iter_mut().for_each(|element| *element = NOISE * normal());
        let found = of(&folder);
        assert_eq!(found.cables, [Wiring::MonitorsDead(vec![7]), Wiring::CorrectorsDead(vec![20])]);
        assert!(!found.folder.monitors[7].is_used && !found.folder.correctors[20].is_used);
        assert_eq!(found.fit.elements, 23 * 23 + 23);
    }

    #[test]
    fn a_measurement_that_tells_nothing_is_refused() {
        let ring = ring();
        let mut folder = measured(&ring, &machine(&ring, 12), NOISE, 1);
        folder.monitors.iter_mut().skip(2).for_each(|one| one.is_used = false);
        let of = |folder: &Folder| Straightened::of(folder, &Settings::default(), &mut |_| ());
        assert!(of(&folder).is_ok());
        folder.monitors[..2].iter_mut().for_each(|one| one.is_used = false);
        let refused = of(&folder).unwrap_err().to_string();
        assert_eq!(refused, "ring: no element of the matrix counts: of 24 monitors 0 are in use, of 24 correctors 24");
    }

    #[test]
    fn a_matrix_in_another_unit_is_refused() {
        let ring = ring();
        let plain = measured(&ring, &machine(&ring, 12), NOISE, 1);
        for unit in [0.01, 10.0, 1000.0] {
            let mut folder = plain.clone();
            folder.matrix *= unit;
            let refused = Straightened::of(&folder, &Settings::default(), &mut |_| ()).unwrap_err().to_string();
            assert!(refused.contains("the unit of the matrix or of the kicks is another one"), "{refused}");
        }
    }

    /// Of 2500 exchanges of two correctors in 19 rings ten do not show by the lattice as written; beside a fit all do.
    #[test]
    fn what_only_a_fit_shows_is_put_right() {
        let ring = ring();
        for (seed, pair) in [(8, [1, 10]), (16, [0, 9])] {
            let plain = measured(&ring, &machine(&ring, seed), NOISE, seed);
            assert_eq!(of(&plain).cables, []);
            let (mut folder, cable) = (plain.clone(), Wiring::CorrectorsExchanged(pair.to_vec()));
            cable.put_right(&mut folder);
            assert_eq!(straightened(&folder, &Settings::default()).unwrap().1, []);
            let found = of(&folder);
            assert_eq!(found.cables, [cable]);
            assert!(found.folder.matrix == plain.matrix);
        }
    }
}
