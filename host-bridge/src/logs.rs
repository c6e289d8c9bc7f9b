//! What the program says on stderr: plain lines, or one JSON object a line for programs that collect them.

use core::fmt;
use std::io::stderr;
use std::sync::OnceLock;

use serde::Deserialize;
use tracing::{Event, Subscriber};
use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::fmt::format::{FormatEvent, FormatFields, Writer};
use tracing_subscriber::fmt::{FmtContext, layer};
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{Layer, Registry, reload};

/// Form of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// `orbitcal: ` and what is to be said.
    Plain,
    /// An object with `timestamp`, `level` (INFO or WARN) and `message`.
    Json,
}

type Boxed = Box<dyn Layer<Registry> + Send + Sync>;

/// The form in use.
static FORM: OnceLock<reload::Handle<Boxed, Registry>> = OnceLock::new();

/// Begin with plain lines; without this nothing is said.
pub fn start() {
    let (layer, handle) = reload::Layer::new(form(Form::Plain));
    if tracing_subscriber::registry().with(layer).with(LevelFilter::INFO).try_init().is_ok() {
        let _ = FORM.set(handle);
    }
}

/// Go on with lines of this form.
pub fn change(to: Form) {
    if let Some(handle) = FORM.get() {
        let _ = handle.reload(form(to));
    }
}

fn form(form: Form) -> Boxed {
    // nobody reads what is said of a line that nobody reads
    match form {
        Form::Plain => Box::new(layer().event_format(Plain).with_writer(stderr).log_internal_errors(false)),
        Form::Json => {
            let lines = layer().json().flatten_event(true).with_target(false).with_writer(stderr);
            Box::new(lines.log_internal_errors(false))
        }
    }
}

struct Plain;

impl<S: Subscriber + for<'l> LookupSpan<'l>, N: for<'w> FormatFields<'w> + 'static> FormatEvent<S, N> for Plain {
    fn format_event(&self, context: &FmtContext<'_, S, N>, mut to: Writer<'_>, event: &Event<'_>) -> fmt::Result {
        write!(to, "orbitcal: ")?;
        context.field_format().format_fields(to.by_ref(), event)?;
        writeln!(to)
    }
}
