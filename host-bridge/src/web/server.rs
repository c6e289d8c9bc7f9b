//! The server of the page: it reads the board, whoever asks, and changes nothing.

use core::fmt::Display;
use core::net::SocketAddr;
use std::sync::Arc;
use std::thread;

use tiny_http::{Header, Method, Request, Response, Server};

use super::board::Board;
use super::state;

/// Requests that are served side by side: one that takes its reply slowly does not hold up the others.
const WORKERS: usize = 3;
/// The page loads from its own server only, in no frame of another page.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; frame-ancestors 'none'";

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
    let wrong = |reason: &dyn Display| WebError::Listen { address, reason: reason.to_string() };
    let server = Arc::new(Server::http(address).map_err(|error| wrong(&error))?);
    for _ in 0..WORKERS {
        let (server, board) = (server.clone(), board.clone());
        let worker = move || {
            while let Ok(request) = server.recv() {
                // whoever asked may be gone
                let _ = serve(request, &board);
            }
        };
        thread::Builder::new().name("page".into()).spawn(worker).map_err(|error| wrong(&error))?;
    }
    server.server_addr().to_ip().ok_or_else(|| wrong(&"no address"))
}

fn serve(request: Request, board: &Board) -> std::io::Result<()> {
    if !matches!(request.method(), Method::Get | Method::Head) {
        return request.respond(Response::from_string("only GET: nothing can be changed here\n").with_status_code(405));
    }
    if !is_for_us(&request) {
        return request.respond(Response::from_string("another host was asked\n").with_status_code(421));
    }
    let (path, query) = request.url().split_once('?').unwrap_or((request.url(), ""));
    let (kind, body) = match path {
        "/" => ("text/html; charset=utf-8", PAGE.to_owned()),
        "/page.css" => ("text/css; charset=utf-8", STYLE.to_owned()),
        "/page.js" => ("text/javascript; charset=utf-8", SCRIPT.to_owned()),
        "/ring.json" => ("application/json", state::ring(board)),
        "/state.json" => ("application/json", state::now(board)),
        "/trail.json" => match state::trail(board, query) {
            Some(body) => ("application/json", body),
            None => return request.respond(Response::from_string("no such span or var\n").with_status_code(404)),
        },
        "/metrics" => ("application/openmetrics-text; version=1.0.0; charset=utf-8", board.metrics.text(&board.queue)),
        _ => return request.respond(Response::from_string("not found\n").with_status_code(404)),
    };
    let headers = [
        ("Content-Type", kind),
        ("Content-Security-Policy", POLICY),
        ("X-Content-Type-Options", "nosniff"),
        ("Cache-Control", "no-store"),
    ];
    let response = Response::from_string(body);
    let header = |(name, value): (&str, &str)| Header::from_bytes(name, value).expect("both are ASCII");
    request.respond(headers.into_iter().fold(response, |response, pair| response.with_header(header(pair))))
}

/// True if this machine was asked: a page from elsewhere, whose name was made to point here, is not served.
fn is_for_us(request: &Request) -> bool {
    let host = request.headers().iter().find(|header| header.field.equiv("Host"));
    host.is_none_or(|host| {
        let host = host.value.as_str();
        let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
        name == "localhost" || name.trim_matches(['[', ']']).parse().is_ok_and(|ip: core::net::IpAddr| ip.is_loopback())
    })
}
