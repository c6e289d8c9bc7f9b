//! What is known of the machine of a loop beforehand: its tables, its setup, the response of its design.

use core::error::Error;

use estimator::booster::{CORRECTORS, Green, MONITORS, PARAMS, SUPPLIES, Setup};
use estimator::{Response, Surrogate, Walk};
use inference::Recording;
use inference::stream::{self, Core};
use twin::Ring;

use crate::machine::LAYOUT;
use crate::repository;

/// How far vars and baselines of the machine are believed to walk.
pub(super) const WALK: Walk = Walk { params: 2e-5, baselines: 5e-6 };

/// The tables, the setup and the linearised design of a Booster.
#[derive(Debug, Clone)]
pub struct Known {
    /// Tables.
    pub surrogate: Box<Green>,
    /// Priors, noise, calibration.
    pub setup: Setup,
    design: Box<<Green as Surrogate<MONITORS, CORRECTORS, SUPPLIES, PARAMS>>::Linearised>,
}

impl Known {
    /// A core at its prior, with the setup of a recording.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn core() -> Result<Core, Box<dyn Error>> {
        let ring = Ring::booster();
        let recording = Recording::read(&repository("recordings/paper-vars"), &ring)?;
        let mut core = stream::estimator(&ring, &recording, WALK)?;
        core.setup.tune_calibration = None;
        Ok(Core::try_new(&ring, core.setup)?)
    }

    /// From the header of a recording.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn read() -> Result<Self, Box<dyn Error>> {
        let core = Self::core()?;
        let mut surrogate = Box::new(Green::BLANK);
        core.tables.fill(&mut *surrogate).map_err(|_| "tables of the Booster")?;
        let mut design = Box::new(<Green as Surrogate<MONITORS, CORRECTORS, SUPPLIES, PARAMS>>::UNLINEARISED);
        Surrogate::<MONITORS, CORRECTORS, SUPPLIES, PARAMS>::linearise(
            &*surrogate,
            &[0.0; PARAMS],
            &[0.0; SUPPLIES],
            &mut design,
        )
        .map_err(|_| "the design has no stable ring")?;
        Ok(Self { surrogate, setup: core.setup.in_room(&LAYOUT), design })
    }
}

impl Known {
    /// The response of the design, as if it were exact.
    pub fn of_design(&self) -> Response<'_, Green, MONITORS, CORRECTORS, SUPPLIES, PARAMS> {
        Response {
            surrogate: &self.surrogate,
            at: &self.design,
            kick_per_ampere: &self.setup.calibration.kick_per_ampere,
            momentum: 1.0,
        }
    }
}
