//! One connection of a browser: requests of bounded length in bounded time, one after the other, and their replies.

use core::time::Duration;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Instant;

/// Bytes of a request's head.
const HEAD: usize = 8192;
/// Headers of a request.
const HEADERS: usize = 64;
/// How long a browser may take for its next request, and for each part of a reply.
const WAIT: Duration = Duration::from_secs(10);

/// What was asked.
#[derive(Debug, PartialEq, Eq)]
pub struct Request {
    /// GET, or another one.
    pub method: String,
    /// Path and query.
    pub target: String,
    /// The host that was asked, and its port.
    pub host: Option<String>,
    /// True where another request may follow.
    stays: bool,
}

/// What is said to it.
#[derive(Debug)]
pub struct Reply {
    /// Code and words.
    pub status: &'static str,
    /// Type of the body.
    pub kind: &'static str,
    /// The body.
    pub body: String,
}

impl Reply {
    /// Why there is nothing else.
    pub fn refusal(status: &'static str, why: &str) -> Self {
        Self { status, kind: "text/plain; charset=utf-8", body: format!("{why}\n") }
    }

    /// With its headers.
    fn bytes(&self, headers: &[(&str, &str)], asked: Option<&Request>) -> Vec<u8> {
        let connection = if asked.is_some_and(|request| request.stays) { "keep-alive" } else { "close" };
        let first = [("Content-Type", self.kind), ("Connection", connection)];
        let headers: String = first.iter().chain(headers).map(|(name, value)| format!("{name}: {value}\r\n")).collect();
        let body = if asked.is_some_and(|request| request.method == "HEAD") { "" } else { &self.body };
        let (status, length) = (self.status, self.body.len());
        format!("HTTP/1.1 {status}\r\nContent-Length: {length}\r\n{headers}\r\n{body}").into_bytes()
    }
}

/// Answer requests until the browser ends the connection, takes too long or asks for something that is no request.
///
/// # Errors
/// Those of the connection.
pub fn converse(
    mut browser: TcpStream,
    headers: &[(&str, &str)],
    answer: impl Fn(&Request) -> Reply,
) -> std::io::Result<()> {
    browser.set_write_timeout(Some(WAIT))?;
    let mut heard = Vec::with_capacity(HEAD);
    loop {
        let (reply, request) = match next(&mut browser, &mut heard)? {
            Next::Request(request) => (answer(&request), Some(request)),
            Next::Refused(status) => (Reply::refusal(status, "no request that is read here"), None),
            Next::End => return Ok(()),
        };
        browser.write_all(&reply.bytes(headers, request.as_ref()))?;
        if !request.is_some_and(|request| request.stays) {
            return Ok(());
        }
    }
}

enum Next {
    Request(Request),
    Refused(&'static str),
    End,
}

fn next(browser: &mut TcpStream, heard: &mut Vec<u8>) -> std::io::Result<Next> {
    let end = Instant::now() + WAIT;
    loop {
        match parsed(heard) {
            Ok(Some((request, length))) => {
                heard.drain(..length);
                return Ok(Next::Request(request));
            }
            Ok(None) if heard.len() < HEAD => (),
            Ok(None) => return Ok(Next::Refused("431 Request Header Fields Too Large")),
            Err(_) => return Ok(Next::Refused("400 Bad Request")),
        }
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Ok(Next::End);
        }
        browser.set_read_timeout(Some(left))?;
        let mut part = [0; HEAD];
        match browser.read(&mut part[..HEAD - heard.len()])? {
            0 => return Ok(Next::End),
            length => heard.extend_from_slice(&part[..length]),
        }
    }
}

/// The first request of some bytes, with the length of its head; none where it goes on.
fn parsed(bytes: &[u8]) -> Result<Option<(Request, usize)>, httparse::Error> {
    let mut headers = [httparse::EMPTY_HEADER; HEADERS];
    let mut head = httparse::Request::new(&mut headers);
    let httparse::Status::Complete(length) = head.parse(bytes)? else { return Ok(None) };
    let value = |name: &str| {
        let header = head.headers.iter().find(|header| header.name.eq_ignore_ascii_case(name));
        header.map(|header| String::from_utf8_lossy(header.value).into_owned())
    };
    // a body is not read: what follows it would be
    let has_body = value("Transfer-Encoding").is_some() || value("Content-Length").is_some_and(|length| length != "0");
    let closes = value("Connection").is_some_and(|connection| connection.eq_ignore_ascii_case("close"));
    let request = Request {
        method: head.method.unwrap_or_default().into(),
        target: head.path.unwrap_or_default().into(),
        host: value("Host"),
        stays: head.version == Some(1) && !closes && !has_body,
    };
    Ok(Some((request, length)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::TcpListener;
    use std::thread;

    /// What is said to these bytes until the connection ends.
    fn said(bytes: &[u8]) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut browser = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (accepted, _) = listener.accept().unwrap();
        let echo = |request: &Request| Reply::refusal("200 OK", &format!("{} {}", request.method, request.target));
        let served = thread::spawn(move || converse(accepted, &[("X-Own", "1")], echo));
        browser.write_all(bytes).unwrap();
        browser.shutdown(std::net::Shutdown::Write).unwrap();
        let mut said = String::new();
        browser.read_to_string(&mut said).unwrap();
        served.join().unwrap().unwrap();
        said
    }

    #[test]
    fn requests_are_answered_one_after_the_other() {
        let said = said(
            b"GET /a HTTP/1.1\r\nHost: x\r\n\r\nHEAD /b HTTP/1.1\r\nConnection: close\r\n\r\nGET /c HTTP/1.1\r\n\r\n",
        );
        let head = |connection: &str| {
            format!(
                "HTTP/1.1 200 OK\r\nContent-Length: 7\r\nContent-Type: text/plain; charset=utf-8\r\nConnection: {connection}\r\nX-Own: 1\r\n\r\n"
            )
        };
        let first = head("keep-alive");
        assert_eq!(said, format!("{first}GET /a\n{}", head("close").replace("h: 7", "h: 8")));
    }

    #[test]
    fn what_is_no_request_is_refused_and_ends() {
        for (bytes, status) in [
            (&b"\0\0\0\0"[..], "400"),
            (b"GET / HTTP/9.9\r\n\r\n", "400"),
            (&[b"GET / HTTP/1.1\r\nX: ", &[b'x'; HEAD - 19][..]].concat(), "431"),
            (b"POST / HTTP/1.1\r\nContent-Length: 18446744073709551615\r\n\r\n", "200"),
        ] {
            let said = said(bytes);
            assert!(said.starts_with(&format!("HTTP/1.1 {status}")) && said.contains("Connection: close"), "{said}");
        }
        assert_eq!(said(b"GET / HT"), "");
    }
}
