//! Checks on requests that pass through this machine: from pages of other sites in a local user's browser, and
//! forwarded by a proxy.

use std::net::IpAddr;

use axum::http::{HeaderMap, header};

use crate::errors::Error;
use crate::headers::header_text;

/// Refuses requests that are not sent by a program of this machine for itself, nor by a page that may.
pub fn check_local(headers: &HeaderMap, origins: &[String]) -> Result<(), Error> {
    check_direct(headers)?;
    check_host(headers)?;
    check_origin(headers, origins)?;
    check_not_embedded(headers)
}

/// Refuses requests addressed to another host (DNS rebinding).
fn check_host(headers: &HeaderMap) -> Result<(), Error> {
    let host = header_text(headers, header::HOST).unwrap_or_default();
    if is_loopback_host(without_port(host)) {
        return Ok(());
    }
    Err(Error::Foreign {
        what: format!("the request is addressed to {host:?}, but this portal serves only this machine"),
        next: "use 127.0.0.1 or localhost, or configure tokens, as a proxy in front of it needs".to_owned(),
    })
}

/// Refuses pages of other machines, except from allowed origins.
pub fn check_origin(headers: &HeaderMap, allowed: &[String]) -> Result<(), Error> {
    let Some(origin) = header_text(headers, header::ORIGIN) else {
        return Ok(());
    };
    let of_this_machine = origin
        .split_once("://")
        .is_some_and(|(scheme, host)| scheme.starts_with("http") && is_loopback_host(without_port(host)));
    if of_this_machine || allowed.iter().any(|allowed| allowed.trim_end_matches('/') == origin) {
        return Ok(());
    }
    Err(Error::Foreign {
        what: format!("a page of {origin} may not use this portal"),
        next: format!("if it should, add it to the configuration: origins = [{origin:?}]"),
    })
}

/// Refuses what a page of another site embeds (an image, a script, a frame): the browser hides the response from the
/// page, but reveals whether there was one, and so what exists here. Browsers tell where a request comes from (Fetch
/// Metadata, W3C); requests with an origin are decided by it, and a person following a link is answered.
pub fn check_not_embedded(headers: &HeaderMap) -> Result<(), Error> {
    let is = |name: &str, values: &[&str]| {
        let said = headers.get(name).and_then(|value| value.to_str().ok());
        said.is_some_and(|said| values.contains(&said))
    };
    let elsewhere = is("sec-fetch-site", &["cross-site", "same-site"]);
    let follows = is("sec-fetch-mode", &["navigate"]) && is("sec-fetch-dest", &["document"]);
    if elsewhere && !follows && !headers.contains_key(header::ORIGIN) {
        Err(Error::Foreign {
            what: "a page of another site may not embed this portal's answers".to_owned(),
            next: "open the address itself, or ask with a token (Authorization: Bearer TOKEN)".to_owned(),
        })
    } else {
        Ok(())
    }
}

/// Headers added by proxies.
const PROXY_HEADERS: [&str; 6] =
    ["forwarded", "via", "x-forwarded-for", "x-forwarded-host", "x-forwarded-proto", "x-real-ip"];

/// Refuses requests with a proxy's headers: their clients are on other machines, whatever `Host` says.
fn check_direct(headers: &HeaderMap) -> Result<(), Error> {
    match PROXY_HEADERS.iter().find(|name| headers.contains_key(**name)) {
        None => Ok(()),
        Some(name) => Err(Error::Foreign {
            what: format!(
                "a proxy passes this request on (its header {name} says so), but this portal has no tokens to identify \
                    the caller"
            ),
            next: "configure tokens, and send one: Authorization: Bearer TOKEN, or ?token=TOKEN".to_owned(),
        }),
    }
}

fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) && !name.ends_with(':') => name,
        _ => host,
    }
}

fn is_loopback_host(host: &str) -> bool {
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    host.eq_ignore_ascii_case("localhost") || bare.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}
