//! The command line.

use core::ops::RangeInclusive;
use core::time::Duration;
use std::path::PathBuf;

use clap::builder::TypedValueParser;
use clap::{Args, Parser, Subcommand, ValueEnum};
use host_bridge::source::Rate;
use host_bridge::source::address::Address;
use inference::nuts::NutsSettings;
use lattices::export;
use lattices::import::{self, Pattern};
use shared_memory::{PUBLISHER, SERVICE};
use twin::limits::{self, ELEMENTS, FINITE, POSITIVE, SECONDS};
use twin::{EffectText, ParameterPrior};
use validation::UnmodelledKind;

/// Real-time Bayesian calibration of an accelerator's digital twin.
#[derive(Debug, Parser)]
#[command(name = "orbitcal", version, max_term_width = 80)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What the program can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Say what a recording holds, and what can be done with it
    Check(Check),
    /// Stream a recording through the core and publish every estimate
    Replay(Replay),
    /// Show published estimates live, from another process
    Watch(Watch),
    /// Orbit response, tunes and dispersion of the twin
    Response(Response),
    /// Fit all frames of a recording at once, with the exact twin
    Fit(Fit),
    /// The published studies of a recording, as one report
    Study(Study),
    /// Find what the model of a recording lacks, tested on held-out frames
    Diagnose(Diagnose),
    /// The calibrated ring as a lattice file of another code
    Export(Export),
    /// A lattice of another code and a response matrix as a folder for fit, diagnose and compare
    Import(Import),
    /// The raw orbits of a measured response as a recording, instruments as fitted
    Frames(Frames),
    /// What changed between two measurements of one machine
    Compare(Compare),
    /// Put an effect into a recording or a measured matrix, its answer key beside it
    Conceal(Conceal),
    /// Diagnose the recordings below a folder, score them by their truth.json
    Challenge(Challenge),
    /// Diagnose simulated blind campaigns, count how often the result is right
    Validate(Validate),
    /// Run the daemon of a configuration, or publish the estimates of a device
    Serve(Serve),
    /// Ask a running daemon for a snapshot, a reset, or another model
    Request(Request),
    /// Show what a daemon has estimated over hours and months
    History(History),
    /// Measure a campaign through the control system, and put the machine back
    Measure(Measure),
    /// Simulate the machine of a plan, one cycle a line, for a soft IOC
    Simulate(Simulate),
    /// Surrogates and their measured errors
    Surrogate(Surrogate),
    /// Train the network of the built-in Booster on the twin, and write its tables
    Train(Train),
}

/// Options that every command has.
#[derive(Debug, Args)]
pub struct Common {
    /// Write the result as JSON to FILE, `-` for stdout
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Machine file; the built-in AGS Booster without it
    #[arg(long, value_name = "FILE")]
    pub machine: Option<PathBuf>,
    /// Print nothing but errors
    #[arg(long)]
    pub quiet: bool,
}

impl Common {
    /// Whether a person wants to read the result on stdout.
    pub fn speaks(&self) -> bool {
        !self.quiet && self.json.as_deref() != Some("-".as_ref())
    }
}

/// Priors of the strength factors (vars); those of the machine file without them.
#[derive(Debug, Clone, Copy, Args)]
pub struct Priors {
    /// Width of the prior of every var, such as 0.03; the machine file's without it
    #[arg(long, value_name = "W", value_parser = number(ParameterPrior::WIDTHS))]
    pub prior_width: Option<f64>,
    /// Range of every var, such as 0.94,1.06; the machine file's without it
    #[arg(long, value_name = "LOW,HIGH", value_parser = range)]
    pub range: Option<Range>,
}

/// Smallest and largest value of a var.
pub type Range = [f64; 2];

/// How estimates are published.
#[derive(Debug, Args)]
pub struct Publishing {
    /// Name of the shared-memory service
    #[arg(long, value_name = "SERVICE", default_value = SERVICE)]
    pub service: String,
    /// Name of this publisher, which `orbitcal watch` shows
    #[arg(long, value_name = "NAME", default_value = PUBLISHER)]
    pub name: String,
    /// Publish nothing
    #[arg(long)]
    pub no_publish: bool,
}

/// `orbitcal check`.
#[derive(Debug, Args)]
pub struct Check {
    /// Folder with header.toml and frames.csv
    pub recording: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
}

/// `orbitcal replay`.
#[derive(Debug, Args)]
pub struct Replay {
    /// Folder with header.toml and frames.csv
    pub recording: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub priors: Priors,
    /// Random walk of each ln var, standard deviation per sqrt(cycle), lost cycles counted; 0 for a campaign, whose vars are constant
    #[arg(long, value_name = "S", default_value_t = 0.0, value_parser = single(VAR_WALKS))]
    pub process_noise: f32,
    /// Random walk of each baseline [um per sqrt(cycle)]: an orbit that drifts from frame to frame
    #[arg(long, value_name = "UM", default_value_t = 0.0, value_parser = single(BASELINE_WALKS), conflicts_with = "follow")]
    pub baseline_walk: f32,
    /// Follow a machine whose vars and baselines may drift, and look for steps of single vars
    #[arg(long, conflicts_with = "process_noise")]
    pub follow: bool,
    /// One CSV row a frame
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
    /// Frames a second, or `max`
    #[arg(long, value_name = "HZ", default_value = "max")]
    pub rate: Rate,
    /// Which prediction
    #[arg(long, value_enum, default_value_t = CoreModel::Green)]
    pub model: CoreModel,
    /// Tables of a machine with the physics that a diagnosis found, instead of the design's
    #[arg(long, value_name = "FILE")]
    pub model_file: Option<PathBuf>,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub publishing: Publishing,
}

/// `orbitcal serve`.
#[derive(Debug, Args)]
pub struct Serve {
    /// Configuration of the daemon, such as config/booster.toml: the core here, fed by raw frames
    #[arg(value_name = "CONFIG.toml", required_unless_present = "source", conflicts_with = "source")]
    pub config: Option<PathBuf>,
    /// Say everything that is wrong with the configuration, and start nothing
    #[arg(long, requires = "config")]
    pub check: bool,
    /// Where the device is: tcp://HOST:PORT, unix:PATH or serial:PATH[@BAUD]
    #[arg(long)]
    pub source: Option<Address>,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
    /// Send it the frames of this recording; without it, a front end does
    #[arg(long, value_name = "RECORDING")]
    pub feed: Option<PathBuf>,
    /// Send it the tables of the machine first; otherwise the device keeps its tables
    #[arg(long, requires = "feed")]
    pub load: bool,
    /// Random walk of each ln var, standard deviation per sqrt(cycle), of constant baselines; without it, vars walk by 1.5e-4
    /// and baselines by 2 um per sqrt(second)
    #[arg(long, value_name = "S", requires = "feed", value_parser = single(VAR_WALKS))]
    pub process_noise: Option<f32>,
    /// One CSV row a frame
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
    /// Frames a second, or `max`
    #[arg(long, value_name = "HZ", default_value = "max")]
    pub rate: Rate,
    /// Stop after this many estimates of frames that a front end sends
    #[arg(long, value_name = "N")]
    pub count: Option<u64>,
    /// Which prediction
    #[arg(long, value_enum, default_value_t = CoreModel::Green)]
    pub model: CoreModel,
    /// Tables of a machine with the physics that a diagnosis found, instead of the design's
    #[arg(long, value_name = "FILE", requires = "feed")]
    pub model_file: Option<PathBuf>,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub publishing: Publishing,
}

/// `orbitcal request`.
#[derive(Debug, Args)]
pub struct Request {
    /// What is asked
    #[command(subcommand)]
    pub ask: Ask,
    /// Name of the shared-memory service of the daemon's estimates
    #[arg(long, value_name = "SERVICE", default_value = SERVICE, global = true)]
    pub service: String,
}

/// What is asked of a daemon.
#[derive(Debug, Subcommand)]
pub enum Ask {
    /// A checkpoint of now, into a file
    Snapshot {
        /// The file
        #[arg(value_name = "FILE")]
        out: PathBuf,
    },
    /// The core back to its prior
    Reset,
    /// Tables of a machine with the physics that a diagnosis found
    Model {
        /// The file
        #[arg(value_name = "FILE")]
        file: PathBuf,
    },
    /// The orbit feedback on, from where the correctors are, or off
    Feedback {
        /// Which
        #[arg(value_enum)]
        state: Switch,
    },
}

/// On or off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[allow(missing_docs)] // their names
pub enum Switch {
    On,
    Off,
}

/// `orbitcal history`.
#[derive(Debug, Args)]
pub struct History {
    /// The daemon's configuration, or the folder of its history; the daemon may be running
    #[arg(value_name = "CONFIG.toml|FOLDER")]
    pub from: PathBuf,
    /// Show this var; may be given again
    #[arg(long = "var", value_name = "NAME")]
    pub vars: Vec<String>,
    /// Begin at this time in UTC (2026-11-24, 2026-11-24T18:30), or so long ago (90m, 36h, 7d)
    #[arg(long, value_name = "WHEN", value_parser = moment)]
    pub since: Option<u64>,
    /// End at this time
    #[arg(long, value_name = "WHEN", value_parser = moment)]
    pub until: Option<u64>,
    /// Lines of the table, spread evenly over the time; JSON and CSV have all rows
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = whole(0..=1_000_000))]
    pub rows: usize,
    /// JSON of all rows, `-` for stdout
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// CSV of all rows, `-` for stdout
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
    /// Print nothing but errors
    #[arg(long)]
    pub quiet: bool,
}

/// `orbitcal watch`.
#[derive(Debug, Args)]
pub struct Watch {
    /// Name of the shared-memory service
    #[arg(long, value_name = "SERVICE", default_value = SERVICE)]
    pub service: String,
    /// One CSV row an estimate
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
    /// Stop after this many estimates
    #[arg(long, value_name = "N")]
    pub count: Option<u64>,
    /// Stop after this many seconds without an estimate
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub idle: Option<Duration>,
    /// Print nothing but errors
    #[arg(long)]
    pub quiet: bool,
}

/// `orbitcal response`.
#[derive(Debug, Args)]
pub struct Response {
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
    /// Quadrupole factors, such as {"D8": 0.958}; the others are 1
    #[arg(long, value_name = "FILE.json")]
    pub vars: Option<PathBuf>,
    /// KIND[@PLACE][=AMPLITUDE], repeatable, such as quad_roll@D8=0.01
    #[arg(long = "effect", value_name = "EFFECT")]
    pub effects: Vec<EffectText>,
    /// What the machine holds
    #[arg(long, value_enum, default_value_t = Rf::FixedMomentum)]
    pub rf: Rf,
}

/// `orbitcal measure`.
#[derive(Debug, Args)]
pub struct Measure {
    /// What is measured, by which channels, within which limits
    #[arg(value_name = "PLAN.toml", required_unless_present = "restore")]
    pub plan: Option<PathBuf>,
    /// Folder of the recording that is made; DIR.journal beside it is there until it is finished
    #[arg(long, value_name = "DIR", required_unless_present_any = ["dry_run", "restore"])]
    pub out: Option<PathBuf>,
    /// Check the plan and all channels, say what would be done, and write nothing
    #[arg(long)]
    pub dry_run: bool,
    /// Put the machine back as the journal of a killed measurement says
    #[arg(long, value_name = "JOURNAL", conflicts_with_all = ["plan", "out", "dry_run"])]
    pub restore: Option<PathBuf>,
    /// The program that speaks EPICS
    #[arg(long, value_name = "PROGRAM", default_value = ".venv-control/bin/orbitcal-epics")]
    pub epics: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
}

/// `orbitcal simulate`.
#[derive(Debug, Args)]
pub struct Simulate {
    /// The plan whose machine and channels are simulated
    #[arg(value_name = "PLAN.toml")]
    pub plan: PathBuf,
    /// Machine file; the built-in AGS Booster without it
    #[arg(long, value_name = "FILE")]
    pub machine: Option<PathBuf>,
    /// Fixes the vars, the misalignments and the noise
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Quadrupole factors, such as {"D8": 0.958}, the others 1; without it they are drawn
    #[arg(long, value_name = "FILE.json")]
    pub vars: Option<PathBuf>,
    /// What the machine has that the design has not, KIND[@PLACE][=AMPLITUDE], repeatable
    #[arg(long = "effect", value_name = "EFFECT")]
    pub effects: Vec<EffectText>,
    /// What fails, repeatable: drop_out@MONITOR=SHARE, freeze@x=CYCLE, stick@CORRECTOR=CYCLE
    #[arg(long = "fault", value_name = "FAULT")]
    pub faults: Vec<String>,
    /// Time constant of the correctors' supplies [s]
    #[arg(long, value_name = "S", default_value_t = 0.3, value_parser = number(SECONDS))]
    pub settling_s: f64,
    /// What is true, for whoever judges: one CSV row a cycle, each monitor's reading [mm] without noise, jumps and faults
    #[arg(long, value_name = "FILE.csv")]
    pub exact: Option<PathBuf>,
}

/// `orbitcal fit`.
#[derive(Debug, Args)]
pub struct Fit {
    /// Folder with header.toml and frames.csv, or with a measured response matrix
    pub recording: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub priors: Priors,
    /// How to fit
    #[arg(long, value_enum, default_value_t = Method::Map)]
    pub method: Method,
    /// Which prediction; the fit by Gauss-Newton is the twin's alone
    #[arg(long, value_enum, default_value_t = FitModel::Twin)]
    pub model: FitModel,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub sampling: Sampling,
    /// Take the design for exact but for the vars, as the core does: dipoles, momentum and kick constants may else be off as those of decks are
    #[arg(long)]
    pub exact_design: bool,
    /// What the machine held while a response matrix was measured; the frequency without it
    #[arg(long, value_enum)]
    pub rf: Option<Rf>,
    /// The optics of the calibrated ring with error bars, of a matrix its instruments too, as one page
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// Folder for the draws, one CmdStan CSV a chain, as `arviz.from_cmdstan` reads it
    #[arg(long, value_name = "DIR")]
    pub save_draws: Option<PathBuf>,
}

/// `orbitcal study`.
#[derive(Debug, Args)]
pub struct Study {
    /// Folder with header.toml and frames.csv
    pub recording: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub priors: Priors,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub sampling: Sampling,
    /// The report, one file with all figures and their numbers
    #[arg(long, value_name = "FILE.html", default_value = "study.html")]
    pub report: PathBuf,
}

/// `orbitcal diagnose`.
#[derive(Debug, Args)]
pub struct Diagnose {
    /// Folders with header.toml and frames.csv; several of one machine are analysed together. Or one with a measured response matrix
    #[arg(required = true, value_name = "RECORDING")]
    pub recordings: Vec<PathBuf>,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub priors: Priors,
    /// The report, one file with all figures and their numbers
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// What the model of a measured response matrix holds; the frequency without it
    #[arg(long, value_enum)]
    pub rf: Option<Rf>,
    /// The model of a measured response matrix that is believed: JSON of `orbitcal fit` of this ring, for what the measurement says against it
    #[arg(long, value_name = "FIT.json")]
    pub model_file: Option<PathBuf>,
    /// Take values out of that model: a place (`x_BPM.3`, `SD*`) or a kind and a place (`skew_gradient *`); may be given again
    #[arg(long, value_name = "NAME", requires = "model_file")]
    pub without: Vec<String>,
    /// The model with what was identified, for `orbitcal replay --model-file` and for a device
    #[arg(long, value_name = "FILE")]
    pub model_out: Option<PathBuf>,
    /// The plan by which the recordings were measured, for --plan-out
    #[arg(long, value_name = "PLAN.toml")]
    pub plan: Option<PathBuf>,
    /// Where the data cannot decide: the measurement that would, for `orbitcal measure`, within the channels and limits of --plan
    #[arg(long, value_name = "NEXT.toml", requires = "plan")]
    pub plan_out: Option<PathBuf>,
}

/// `orbitcal export`.
#[derive(Debug, Args)]
pub struct Export {
    /// JSON of fit, replay or diagnose
    #[arg(value_name = "FIT.json")]
    pub result: PathBuf,
    /// Which format
    #[arg(long = "as", value_enum)]
    pub format: Format,
    /// The file, `-` for stdout
    #[arg(long, value_name = "FILE", default_value = "-")]
    pub out: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
}

/// Lattice formats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// A sequence for MAD-X
    Madx,
    /// A lattice for Bmad and Tao
    Bmad,
    /// JSON for pyAT
    At,
    /// JSON for Xsuite
    Xsuite,
    /// JSON in the Particle Accelerator Lattice Standard
    Pals,
}

impl From<Format> for export::Format {
    fn from(format: Format) -> Self {
        match format {
            Format::Madx => Self::Madx,
            Format::Bmad => Self::Bmad,
            Format::At => Self::At,
            Format::Xsuite => Self::Xsuite,
            Format::Pals => Self::Pals,
        }
    }
}

/// `orbitcal import`.
#[derive(Debug, Args)]
pub struct Import {
    /// Lattice by pyAT or Xsuite (JSON), AT (MAT-file), MAD-X (twiss table) or in PALS; or a LOCO file (MAT-file), which has the matrix too
    pub lattice: PathBuf,
    /// The measured response matrix: a plain table, FILE.h5:/PATH, FILE.mat:NAME, or one of the Matlab Middle Layer, of pyAML or in SDDS; several are blocks of one, such as of each plane. Without it, the lattice is shown and nothing is written
    #[arg(long, value_name = "FILE", requires = "out")]
    pub matrix: Vec<PathBuf>,
    /// Folder that is made
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Monitors by name, such as 'BPM*' or 'x:BPMH*', or by a field of an AT file, 'CommonName=BPM*', repeatable; by type without it
    #[arg(long, value_name = "PATTERN")]
    pub monitors: Vec<Pattern>,
    /// Correctors by name in the same way
    #[arg(long, value_name = "PATTERN")]
    pub correctors: Vec<Pattern>,
    /// Unit of the orbit in the matrix
    #[arg(long, value_enum)]
    pub orbit_unit: Option<OrbitUnit>,
    /// Deflection [mrad] that an element of the matrix belongs to: a number, x=NUMBER,y=NUMBER, or a file of names and numbers
    #[arg(long, value_name = "MRAD")]
    pub kick: Option<String>,
    /// What that deflection counts
    #[arg(long, value_enum)]
    pub kick_is: Option<KickIs>,
    /// Whether a plus deflects to larger x, to larger y
    #[arg(long, value_enum)]
    pub kick_sign: Option<KickSign>,
    /// Standard deviation of an element of the matrix, in its unit: as for --kick
    #[arg(long, value_name = "NUMBER")]
    pub noise: Option<String>,
    /// Order of lines and columns that have no names
    #[arg(long, value_enum)]
    pub order: Option<Order>,
    /// Change of the orbit with a step of the RF frequency, in the unit of the matrix
    #[arg(long, value_name = "FILE", requires = "rf_step", requires = "matrix")]
    pub dispersion: Option<PathBuf>,
    /// That step [Hz]
    #[arg(long, value_name = "HZ", requires = "dispersion", allow_hyphen_values = true, value_parser = number(FINITE))]
    pub rf_step: Option<f64>,
    /// RF frequency [Hz]; that of the lattice's cavities without it
    #[arg(long, value_name = "HZ", value_parser = number(POSITIVE))]
    pub rf_frequency: Option<f64>,
    /// What the machine held while the matrix was measured, for the comparison with the lattice; the frequency without it
    #[arg(long, value_enum)]
    pub rf: Option<Rf>,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
}

/// Units of an orbit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum OrbitUnit {
    /// Millimetres
    Mm,
    /// Metres
    M,
    /// Micrometres
    Um,
}

impl From<OrbitUnit> for import::OrbitUnit {
    fn from(unit: OrbitUnit) -> Self {
        match unit {
            OrbitUnit::Mm => Self::Millimetres,
            OrbitUnit::M => Self::Metres,
            OrbitUnit::Um => Self::Micrometres,
        }
    }
}

/// What the number of a kick counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum KickIs {
    /// The two orbits differ by that kick
    Full,
    /// The orbits are at plus and at minus that kick
    Half,
}

impl From<KickIs> for import::KickIs {
    fn from(kick: KickIs) -> Self {
        match kick {
            KickIs::Full => Self::Full,
            KickIs::Half => Self::Half,
        }
    }
}

/// Where a plus deflects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum KickSign {
    /// To larger x and larger y, as in MAD-X and pyAT
    #[value(name = "x+y+")]
    Both,
    /// To smaller x and larger y
    #[value(name = "x-y+")]
    Upwards,
    /// To larger x and smaller y
    #[value(name = "x+y-")]
    Outwards,
    /// To smaller x and smaller y
    #[value(name = "x-y-")]
    Neither,
}

impl From<KickSign> for import::Signs {
    fn from(sign: KickSign) -> Self {
        Self(match sign {
            KickSign::Both => [true, true],
            KickSign::Upwards => [false, true],
            KickSign::Outwards => [true, false],
            KickSign::Neither => [false, false],
        })
    }
}

/// Orders of lines and columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Order {
    /// All of x in beam order, then all of y
    Planes,
    /// x and y of each in turn
    Pairs,
}

impl From<Order> for import::Order {
    fn from(order: Order) -> Self {
        match order {
            Order::Planes => Self::Planes,
            Order::Pairs => Self::Pairs,
        }
    }
}

/// `orbitcal frames`.
#[derive(Debug, Args)]
pub struct Frames {
    /// Folder with a measured response matrix and the raw orbits that it was made of
    #[arg(value_name = "RING")]
    pub measurement: PathBuf,
    /// Folder that is made: the recording, its machine file and the core's model
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Folder of a measurement of the same ring, where RING holds raw orbits alone: its lattice and its instruments, found by their responses
    #[arg(long, value_name = "DIR", requires = "monitors", requires = "correctors")]
    pub lattice: Option<PathBuf>,
    /// How many of the raw orbits' rows are of x, of y
    #[arg(long, value_name = "X,Y", value_parser = counts, requires = "lattice")]
    pub monitors: Option<Counts>,
    /// How many of their columns are of horizontal, of vertical correctors
    #[arg(long, value_name = "H,V", value_parser = counts, requires = "lattice")]
    pub correctors: Option<Counts>,
    /// What the machine held while the orbits were read; the frequency without it
    #[arg(long, value_enum)]
    pub rf: Option<Rf>,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub priors: Priors,
}

/// How many of each plane.
pub type Counts = [usize; 2];

/// `orbitcal compare`.
#[derive(Debug, Args)]
pub struct Compare {
    /// The earlier measurement: a folder with a response matrix, or a recording
    #[arg(value_name = "A")]
    pub before: PathBuf,
    /// The later one, of the same machine and instruments
    #[arg(value_name = "B")]
    pub after: PathBuf,
    /// The changes as one page
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// What measured matrices hold while a corrector changes, if it is not the RF frequency
    #[arg(long, value_enum)]
    pub rf: Option<Rf>,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub priors: Priors,
}

/// `orbitcal conceal`.
#[derive(Debug, Args)]
pub struct Conceal {
    /// A recording, or a folder with a response matrix
    #[arg(value_name = "DATA")]
    pub data: PathBuf,
    /// Fixes kind, place and size
    #[arg(long, value_name = "N")]
    pub seed: u64,
    /// Folder that is made; the answer key is DIR.truth.json beside it
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
}

/// `orbitcal challenge`.
#[derive(Debug, Args)]
pub struct Challenge {
    /// Folder of recordings, each a folder with header.toml, frames.csv and truth.json
    pub folder: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
}

/// `orbitcal validate`.
#[derive(Debug, Args)]
pub struct Validate {
    /// Campaign whose settings, read-backs and gaps the simulated ones have
    pub template: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)] // flattened options carry their own docs
    pub common: Common,
    /// Campaigns of a machine that the model describes
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = whole(0..=100_000))]
    pub empty: usize,
    /// Campaigns with one effect of the library
    #[arg(long, value_name = "N", default_value_t = 280, value_parser = whole(0..=100_000))]
    pub single: usize,
    /// Campaigns with two
    #[arg(long, value_name = "N", default_value_t = 48, value_parser = whole(0..=100_000))]
    pub pair: usize,
    /// Campaigns with an effect that the library does not hold
    #[arg(long, value_name = "N", default_value_t = 8 * UnmodelledKind::ALL.len(), value_parser = whole(0..=100_000))]
    pub unknown: usize,
    /// One line a campaign; campaigns already in the file are not run again
    #[arg(long, value_name = "FILE.jsonl", default_value = "target/validate.jsonl")]
    pub outcomes: PathBuf,
    /// Write the tables between the marks of this page
    #[arg(long, value_name = "FILE.md")]
    pub page: Option<PathBuf>,
    /// Fixes every random choice
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// End with an error at a false identification in an empty campaign or beside effects of the library
    #[arg(long)]
    pub strict: bool,
}

/// How NUTS samples.
#[derive(Debug, Clone, Copy, Args)]
pub struct Sampling {
    /// NUTS: independent chains
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u16).range(1..=256))]
    pub chains: u16,
    /// NUTS: draws of each chain that adapt the step
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(50..=1_000_000))]
    pub warm_up: u32,
    /// NUTS: draws of each chain that are kept
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u32).range(4..=1_000_000))]
    pub draws: u32,
    /// Fixes every random choice
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

impl From<Sampling> for NutsSettings {
    fn from(sampling: Sampling) -> Self {
        Self {
            chains: usize::from(sampling.chains),
            warm_up: sampling.warm_up as usize,
            draws: sampling.draws as usize,
            seed: sampling.seed,
        }
    }
}

/// `orbitcal surrogate`.
#[derive(Debug, Args)]
pub struct Surrogate {
    /// What to do with the surrogates.
    #[command(subcommand)]
    pub action: SurrogateAction,
}

/// What can be done with surrogates.
#[derive(Debug, Subcommand)]
pub enum SurrogateAction {
    /// Make the tables and measure their error against the twin, on Sobol points within the tune cut
    Check {
        #[command(flatten)]
        #[allow(missing_docs)] // flattened options carry their own docs
        common: Common,
        /// Number of points
        #[arg(long, default_value_t = 2000, value_parser = whole(1..=1_000_000))]
        samples: usize,
        /// Seed of the scrambled sequence
        #[arg(long, default_value_t = 1)]
        seed: u32,
        /// A checkpoint of `orbitcal train`: its network in f32 is measured as well
        #[arg(long, value_name = "FILE")]
        checkpoint: Option<PathBuf>,
    },
}

/// `orbitcal train`.
#[derive(Debug, Args)]
pub struct Train {
    /// Folder of the tables, `resnet-x.bin` and `resnet-y.bin`
    #[arg(long, value_name = "DIR", default_value = "training/tables")]
    pub out: PathBuf,
    /// Where training goes on after it was stopped
    #[arg(long, value_name = "FILE", default_value = "target/train.checkpoint")]
    pub checkpoint: PathBuf,
    /// Curves of the errors as a figure
    #[arg(long, value_name = "FILE.svg")]
    pub curves: Option<PathBuf>,
    /// Machines of the training set, in thousands; each is seen once, with all 48 correctors
    #[arg(long, default_value_t = 520, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub machines: u32,
    /// Machines that are learnt with rounded weights after that, in thousands
    #[arg(long, default_value_t = 90, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub rounded: u32,
    /// Seed of everything random
    #[arg(long, default_value_t = 18)]
    pub seed: u32,
    /// Print nothing but errors
    #[arg(long)]
    pub quiet: bool,
}

/// Predictions that the core can make.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum CoreModel {
    /// Quantised Green's function
    Green,
    /// The published network with 8-bit weights; built-in Booster only
    Resnet,
}

impl CoreModel {
    /// Its word on the command line and in the JSON.
    pub fn word(self) -> &'static str {
        match self {
            Self::Green => "green",
            Self::Resnet => "resnet",
        }
    }
}

/// Predictions that the batch fit can make.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FitModel {
    /// The exact twin
    Twin,
    /// The Green's function with the core's tables, in f64
    Green,
    /// The network with the core's weights, in f32; built-in Booster only
    Resnet,
    /// The first order about the design, as one step of LOCO takes it
    Linear,
}

impl From<FitModel> for results::FitModel {
    fn from(model: FitModel) -> Self {
        match model {
            FitModel::Twin => Self::Twin,
            FitModel::Green => Self::Green,
            FitModel::Resnet => Self::Resnet,
            FitModel::Linear => Self::Linear,
        }
    }
}

/// Ways to fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// Damped Gauss-Newton to the maximum a posteriori, Laplace covariance
    Map,
    /// Full NUTS, the reference
    Nuts,
}

/// What the RF does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Rf {
    /// The momentum is held
    FixedMomentum,
    /// The frequency is held, the momentum follows the path length
    FixedFrequency,
}

impl From<Rf> for twin::Rf {
    fn from(rf: Rf) -> Self {
        match rf {
            Rf::FixedMomentum => Self::FixedMomentum,
            Rf::FixedFrequency => Self::FixedFrequency,
        }
    }
}

/// A moment [ms since 1970].
fn moment(text: &str) -> Result<u64, String> {
    let wrong = || format!("expected a time in UTC as 2026-11-24T18:30, or so long ago as 36h, found {text:?}");
    let now = jiff::Timestamp::now().to_zoned_datetime(jiff::tz::TimeZone::UTC);
    let ago = || now.checked_sub(text.parse::<jiff::Span>().ok()?).ok().map(|zoned| zoned.timestamp());
    let civil = || {
        let civil: jiff::civil::DateTime = text.parse().ok()?;
        civil.to_zoned_datetime(jiff::tz::TimeZone::UTC).ok().map(|zoned| zoned.timestamp())
    };
    let moment = text.parse().ok().or_else(civil).or_else(ago).ok_or_else(wrong)?;
    u64::try_from(moment.as_millisecond()).map_err(|_| wrong())
}

fn seconds(text: &str) -> Result<Duration, String> {
    SECONDS.parse(text).map(Duration::from_secs_f64)
}

/// A number of a range.
fn number(range: limits::Range) -> impl Fn(&str) -> Result<f64, String> + Clone {
    move |text: &str| range.parse(text)
}

/// The same in single precision.
fn single(range: limits::Range) -> impl Fn(&str) -> Result<f32, String> + Clone {
    move |text: &str| range.parse(text).map(|number| number as f32)
}

/// A whole number of a range.
fn whole(range: RangeInclusive<u64>) -> impl TypedValueParser<Value = usize> {
    clap::value_parser!(u64).range(range).map(|number| number as usize)
}

/// Random walks of a var, per root of a cycle.
const VAR_WALKS: limits::Range = limits::Range::new(0.0, 0.1, "");
/// Random walks of a baseline, per root of a cycle.
const BASELINE_WALKS: limits::Range = limits::Range::new(0.0, 1000.0, "um");

fn range(text: &str) -> Result<Range, String> {
    let wrong = || format!("expected LOW,HIGH with 0.1 <= LOW < 1 < HIGH <= 10, found {text:?}");
    let (low, high) = text.split_once(',').ok_or_else(wrong)?;
    let bounds = low.trim().parse().ok().zip(high.trim().parse().ok());
    let is_range = |(low, high): &(f64, f64)| (0.1..1.0).contains(low) && *high > 1.0 && *high <= 10.0;
    bounds.filter(is_range).map(|(low, high)| [low, high]).ok_or_else(wrong)
}

fn counts(text: &str) -> Result<Counts, String> {
    let wrong = || format!("expected two whole numbers up to {} such as 122,122, found {text:?}", ELEMENTS.most);
    let all: Vec<usize> =
        text.split(',').map(|one| one.trim().parse()).collect::<Result<_, _>>().map_err(|_| wrong())?;
    let is_few = |counts: &Counts| counts.iter().all(|count| *count as u64 <= ELEMENTS.most);
    all.try_into().ok().filter(is_few).ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory;
        Cli::command().debug_assert();
    }
    #[test]
    fn a_range_holds_one() {
        assert_eq!(range("0.94,1.06"), Ok([0.94, 1.06]));
        for wrong in ["", "0.9", "1.01,1.06", "0.9,0.99", "0.9,nan", "0,2", "0.9,1.1,1.2"] {
            let said = range(wrong).unwrap_err();
            assert_eq!(said, format!("expected LOW,HIGH with 0.1 <= LOW < 1 < HIGH <= 10, found {wrong:?}"));
        }
    }
}
