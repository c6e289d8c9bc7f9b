//! The schemas of the JSON of all commands.

use results::{
    CheckResult, Comparison, DiagnosisResult, FitResult, Imported, MatrixDiagnosis, MatrixFit, ResponseResult, Written,
    schema,
};
use schemars::Schema;
use validation::{Challenge, Tables};

use super::export::ExportResult;
use super::history::HistoryResult;
use super::measure::{DryRun, MeasureResult};
use super::surrogate::Check;

/// Names and schemas of what `--json` writes: one for each command, two where the JSON of a measured matrix or of a dry run is another.
pub fn schemas() -> [(&'static str, Schema); 17] {
    [
        ("challenge", schema::<Challenge>()),
        ("check", schema::<CheckResult>()),
        ("compare", schema::<Comparison>()),
        ("diagnose", schema::<DiagnosisResult>()),
        ("diagnose-matrix", schema::<MatrixDiagnosis>()),
        ("export", schema::<ExportResult>()),
        ("fit", schema::<FitResult>()), // replay and serve write the same
        ("fit-matrix", schema::<MatrixFit>()),
        ("frames", schema::<Written>()),
        ("history", schema::<HistoryResult>()),
        ("import", schema::<Imported>()),
        ("measure", schema::<MeasureResult>()),
        ("measure-dry-run", schema::<DryRun>()),
        ("response", schema::<ResponseResult>()),
        ("study", schema::<studies::Numbers>()),
        ("surrogate-check", schema::<Check>()),
        ("validate", schema::<Tables>()),
    ]
}
