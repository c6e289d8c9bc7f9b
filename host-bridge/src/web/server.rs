//! The server of the page: it reads the board, whoever asks, and changes nothing.

use core::net::SocketAddr;
use core::time::Duration;
use std::net::TcpListener;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use super::board::Board;
use super::connection::{Reply, Request, converse};
use super::state;

/// Connections at a time: further ones are ended at once.
const CONNECTIONS: usize = 256;
/// The page loads from its own server only, in no frame of another page.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; frame-ancestors 'none'";
/// Of every reply.
const HEADERS: &[(&str, &str)] =
    &[("Content-Security-Policy", POLICY), ("X-Content-Type-Options", "nosniff"), ("Cache-Control", "no-store")];

const PAGE: &str = include_str!("page.html");
const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");

/// Why the page is not served.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WebError {
    /// The address belongs to the network.
    #[error("{0}: expected a loopback address; `ssh -L` brings the page to another machine")]
    Network(SocketAddr),
    /// The system does not let us listen there.
    #[error("{address}: the page cannot be served: {reason}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Why.
        reason: String,
    },
}

/// Serve a board, on threads of their own, until the process ends; returns where.
///
/// # Errors
/// [`WebError`].
pub fn start(address: SocketAddr, board: &Arc<Board>) -> Result<SocketAddr, WebError> {
    if !address.ip().is_loopback() {
        return Err(WebError::Network(address));
    }
    let wrong = |reason: std::io::Error| WebError::Listen { address, reason: reason.to_string() };
    let listener = TcpListener::bind(address).map_err(wrong)?;
    let at = listener.local_addr().map_err(wrong)?;
    let board = board.clone();
    thread::Builder::new().name("page".into()).spawn(move || listen(&listener, &board)).map_err(wrong)?;
    Ok(at)
}

fn listen(listener: &TcpListener, board: &Arc<Board>) {
    // one reply is made at a time, so that however many are asked for the loop keeps its processor; each connection has a part of it
    let turn = Arc::new(Mutex::new(()));
    for browser in listener.incoming() {
        let Ok(browser) = browser else {
            // no file descriptor is free
            thread::sleep(Duration::from_millis(100));
            continue;
        };
        if Arc::strong_count(&turn) > CONNECTIONS {
            continue;
        }
        let (board, turn) = (board.clone(), turn.clone());
        let serve = move || {
            let answer = |request: &Request| {
                let _turn = turn.lock().unwrap_or_else(PoisonError::into_inner);
                reply(request, &board)
            };
            // whoever asked may be gone
            let _ = converse(browser, HEADERS, answer);
        };
        // without a thread the connection ends
        let _ = thread::Builder::new().name("page".into()).spawn(serve);
    }
}

fn reply(request: &Request, board: &Board) -> Reply {
    if !matches!(request.method.as_str(), "GET" | "HEAD") {
        return Reply::refusal("405 Method Not Allowed", "only GET: nothing can be changed here");
    }
    if !request.host.as_deref().is_none_or(is_of_this_machine) {
        return Reply::refusal("421 Misdirected Request", "another host was asked");
    }
    let (path, query) = request.target.split_once('?').unwrap_or((&request.target, ""));
    let (kind, body) = match path {
        "/" => ("text/html; charset=utf-8", PAGE.to_owned()),
        "/page.css" => ("text/css; charset=utf-8", STYLE.to_owned()),
        "/page.js" => ("text/javascript; charset=utf-8", SCRIPT.to_owned()),
        "/ring.json" => ("application/json", state::ring(board)),
        "/state.json" => ("application/json", state::now(board)),
        "/trail.json" => match state::trail(board, query) {
            Some(body) => ("application/json", body),
            None => return Reply::refusal("404 Not Found", "no such span or var"),
        },
        "/metrics" => ("application/openmetrics-text; version=1.0.0; charset=utf-8", board.metrics.text(&board.queue)),
        _ => return Reply::refusal("404 Not Found", "not found"),
    };
    Reply { status: "200 OK", kind, body }
}

/// True of a name of this machine: a page from elsewhere, whose name was made to point here, is not served.
fn is_of_this_machine(host: &str) -> bool {
    let name = host.rsplit_once(':').filter(|(_, port)| !port.contains(']')).map_or(host, |(name, _)| name);
    name == "localhost" || name.trim_matches(['[', ']']).parse().is_ok_and(|ip: core::net::IpAddr| ip.is_loopback())
}
