//! What the commands of orbitcal print and write: results as JSON, in words and tables, as pages; and an estimate on its way out.
//!
//! Whatever runs a command (the program, the Python package, the daemon) makes its result here, so that all say the same. Nothing here
//! reads arguments, draws on a terminal or serves anybody. A result serialises as the JSON of its command and displays as its text;
//! why there is none is a [`CommandError`].
//!
//! ```
//! use inference::Recording;
//! use results::{Design, fit_by_steps};
//! use twin::Ring;
//!
//! let ring = Ring::booster();
//! let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/paper-vars");
//! let fit = fit_by_steps(&ring, &Recording::read(folder.as_ref(), &ring)?, Design::Uncertain, |_| ())?;
//! assert_eq!(fit.vars.len(), 48);
//! assert!(fit.to_string().contains("method map, model twin"));
//! assert_eq!(serde_json::to_value(&fit)?["method"], "map");
//! # Ok::<(), Box<dyn core::error::Error>>(())
//! ```

mod campaign;
mod check_result;
mod compare;
mod diagnosis_page;
mod diagnosis_result;
mod draws;
mod error;
mod finite;
mod fit;
mod fit_page;
mod fit_result;
mod frames_result;
mod imperfection;
mod import_result;
mod matrix;
mod matrix_diagnosis;
mod matrix_page;
mod matrix_result;
pub mod model_file;
mod optics;
pub mod output;
mod record;
mod response_result;
mod schema;

pub use campaign::{campaign, expect_modelled, not_modelled, recording, strays, tables};
pub use check_result::CheckResult;
pub use compare::{compare_matrices, compare_recordings};
pub use diagnosis_result::{DiagnosisResult, diagnosis_page};
pub use draws::save_draws;
pub use error::CommandError;
pub use fit::{Design, FitModel, fit_by_draws, fit_by_steps, fit_page};
pub use fit_result::{FitResult, Monitor, Timing, Tunes, TunesMeasured, Var, state_word};
pub use frames_result::Written;
pub use import_result::Imported;
pub use matrix::{DiagnosedMatrix, FittedMatrix};
pub use matrix_diagnosis::MatrixDiagnosis;
pub use matrix_page::page_of as comparison_page;
pub use matrix_result::{Comparison, MatrixFit, StatedModel};
pub use optics::OpticsAt;
pub use record::{EstimateRecord, Names, ReadingUse, Remarked};
pub use response_result::{ResponseResult, factors};
pub use schema::schema;
