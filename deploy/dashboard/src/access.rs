//! Who may read: a request with a local host name and with the token.

use std::sync::Arc;

use anyhow::Context;
use axum::Json;
use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use dmprl_run::failure::wrong_use;
use serde_json::json;
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

/// Accepted values of the `Host` header. This protects against DNS rebinding: in requests of a page
/// whose domain resolves to this machine, the header has that domain.
const LOCAL_HOSTS: [&str; 3] = ["localhost", "127.0.0.1", "[::1]"];
/// Parameter of a URL with the token.
const PARAMETER: &str = "token";
/// Characters of a token, besides letters and digits, that need no escape in URLs and cookies.
const PUNCTUATION: &[u8] = b"-._~";

/// The token that a request must have.
#[derive(Debug)]
pub struct Access {
    token: String,
    /// Name of the cookie. It depends on the token, because a browser sends the cookies of one
    /// dashboard also to another one at the same host name.
    cookie: String,
    set_cookie: HeaderValue,
}

impl Access {
    /// Makes the check for a token.
    ///
    /// # Errors
    /// Wrong use: the token has characters that URLs do not allow.
    pub fn new(token: String) -> anyhow::Result<Self> {
        let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || PUNCTUATION.contains(&byte);
        if !token.bytes().all(is_plain) {
            return Err(wrong_use(
                "the dashboard's token has characters that URLs do not allow: expected letters, \
                 digits, and - . _ ~, such as the output of `openssl rand -hex 32`",
            ));
        }
        let digest = Sha256::digest(&token);
        let cookie = format!("dmprl-{:02x}{:02x}{:02x}", digest[0], digest[1], digest[2]);
        // `Lax`, because with `Strict` a browser that follows a link to the page does not send it.
        let set_cookie = format!("{cookie}={token}; Path=/; HttpOnly; SameSite=Lax");
        let set_cookie = HeaderValue::from_str(&set_cookie).context("a token in a header")?;
        Ok(Self { token, cookie, set_cookie })
    }

    /// Returns the part of the page's URL that has the token.
    #[must_use]
    pub fn query(&self) -> String {
        format!("?{PARAMETER}={}", self.token)
    }

    fn is_token(&self, given: &str) -> bool {
        given.as_bytes().ct_eq(self.token.as_bytes()).into()
    }

    fn is_in_url(&self, uri: &Uri) -> bool {
        let mut pairs = uri.query().unwrap_or_default().split('&');
        pairs.any(|pair| {
            pair.split_once('=')
                .is_some_and(|(key, value)| key == PARAMETER && self.is_token(value))
        })
    }

    fn is_in_headers(&self, headers: &HeaderMap) -> bool {
        let bearer = headers.get(header::AUTHORIZATION).and_then(|value| value.to_str().ok());
        let bearer = bearer.and_then(|value| value.strip_prefix("Bearer "));
        let cookies = headers.get_all(header::COOKIE).iter();
        let cookies = cookies.filter_map(|value| value.to_str().ok());
        let mut cookies = cookies.flat_map(|value| value.split("; "));
        bearer.is_some_and(|token| self.is_token(token))
            || cookies.any(|pair| {
                let pair = pair.split_once('=');
                pair.is_some_and(|(name, value)| name == self.cookie && self.is_token(value))
            })
    }
}

/// Rejects requests with a foreign `Host` header or without the token. The page's URL with the
/// token sets a cookie and redirects to the URL without it, so that the token is not in bookmarks.
pub async fn check(State(access): State<Arc<Access>>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
    match host {
        Some(host) if is_local_host(host) => {}
        _ => return foreign_host(host.unwrap_or_default()),
    }
    let in_url = access.is_in_url(request.uri());
    if in_url && request.method() == Method::GET && request.uri().path() == "/" {
        let headers = [
            (header::LOCATION, HeaderValue::from_static("/")),
            (header::SET_COOKIE, access.set_cookie.clone()),
        ];
        return (StatusCode::SEE_OTHER, headers).into_response();
    }
    if in_url || access.is_in_headers(request.headers()) {
        return next.run(request).await;
    }
    without_token(request.uri().path())
}

fn foreign_host(host: &str) -> Response {
    let message = format!(
        "Host header: expected localhost or 127.0.0.1, got {host:?}; from another machine, use \
         ssh -L 8787:127.0.0.1:PORT and open http://127.0.0.1:8787\n"
    );
    (StatusCode::FORBIDDEN, message).into_response()
}

fn without_token(path: &str) -> Response {
    let message = "this request has no valid token; open the address that dmprl dashboard \
                   printed when it started, which ends with ?token=…";
    let challenge = [(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"))];
    if path.starts_with("/api/") {
        let error = Json(json!({ "error": message }));
        return (StatusCode::UNAUTHORIZED, challenge, error).into_response();
    }
    (StatusCode::UNAUTHORIZED, challenge, format!("{message}\n")).into_response()
}

/// Returns true if a `Host` header names this machine. Any port is accepted, since the port may be
/// forwarded.
fn is_local_host(host: &str) -> bool {
    let host = host.parse::<Authority>();
    host.is_ok_and(|host| LOCAL_HOSTS.iter().any(|name| host.host().eq_ignore_ascii_case(name)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_loopback_names_are_accepted_as_host() {
        for local in ["localhost", "127.0.0.1:8787", "LOCALHOST:1", "[::1]:8787"] {
            assert!(is_local_host(local), "{local}");
        }
        for foreign in ["", "evil.example:8787", "localhost.evil.example", "0.0.0.0", "a b"] {
            assert!(!is_local_host(foreign), "{foreign}");
        }
    }

    #[test]
    fn the_token_is_found_in_url_header_and_cookie() {
        let access = Access::new("0123456789abcdef".to_owned()).unwrap();
        for (uri, expected) in [
            ("/?token=0123456789abcdef", true),
            ("/api/config?run=one&token=0123456789abcdef", true),
            ("/", false),
            ("/?token=", false),
            ("/?token=0123456789abcde", false),
            ("/?token=0123456789abcdef0", false),
            ("/?tokens=0123456789abcdef", false),
        ] {
            assert_eq!(access.is_in_url(&uri.parse().unwrap()), expected, "{uri}");
        }
        let cookie = |name: &str| format!("other=1; {name}=0123456789abcdef");
        for (name, value, expected) in [
            (header::AUTHORIZATION, "Bearer 0123456789abcdef".to_owned(), true),
            (header::AUTHORIZATION, "Bearer 0123456789abcdee".to_owned(), false),
            (header::AUTHORIZATION, "0123456789abcdef".to_owned(), false),
            (header::COOKIE, cookie(&access.cookie), true),
            (header::COOKIE, cookie("dmprl-other"), false),
        ] {
            let headers = HeaderMap::from_iter([(name, value.parse().unwrap())]);
            assert_eq!(access.is_in_headers(&headers), expected, "{value}");
        }
    }

    #[test]
    fn a_token_that_a_url_cannot_have_is_refused() {
        for wrong in ["0123456789abcde&", "0123456789 abcdef", "0123456789abcd\u{e9}f"] {
            let error = Access::new(wrong.to_owned()).unwrap_err().to_string();
            assert!(error.contains("openssl rand") && !error.contains(wrong), "{error}");
        }
    }
}
