//! Requests to a registry (OCI distribution specification 1.1, "Pull"): logging in, redirects, refusals.
//!
//! ```text
//!   GET ─▶ 401 with a challenge ─▶ password (Basic), or token of the token server that it names (Bearer) ─▶ GET again
//!     └──▶ 307 to where blobs are kept ─▶ GET there, without credentials
//! ```
//!
//! What a registry names is asked by HTTPS alone, and never on this machine, unless the registry itself is here.

use anyhow::{Context, anyhow, bail, ensure};
use bytes::Bytes;
use http_body_util::Full;
use hyper::header::{
    ACCEPT, AUTHORIZATION, CONTENT_RANGE, HeaderMap, HeaderValue, LOCATION, RANGE, USER_AGENT, WWW_AUTHENTICATE,
};
use hyper::{Request, Response, StatusCode, Uri};
use outbound::{OutboundBody, OutboundClient, is_loopback_host};
use serde::Deserialize;

use super::challenge::{Challenge, parse_challenges};
use super::credentials::Credentials;
use super::digest::Digest;
use super::documents::MEDIA_TYPES;
use super::reference::ImageReference;
use crate::client::{NAME, percent_encode};

/// Maximum number of redirects of a request.
const MOST_REDIRECTS: usize = 5;
/// Maximum size of the text of a refusal, in bytes, and of what is printed of it, in characters.
const LARGEST_REFUSAL: usize = 16 << 10;
const LONGEST_REFUSAL: usize = 300;

/// Advice when no authorities are installed.
pub const NOBODY_TRUSTED: &str = "no certificate authorities are installed here: apt install ca-certificates";

/// Client for one repository of a registry.
#[derive(Debug)]
pub struct RegistryClient {
    http: OutboundClient,
    image: ImageReference,
    /// Scheme and host of the registry.
    origin: String,
    /// True if the registry is on this machine.
    is_here: bool,
    credentials: Option<Credentials>,
    /// Value of `Authorization` for the registry, once logged in.
    authorization: Option<HeaderValue>,
}

/// Response of a token server; the two names mean the same.
#[derive(Deserialize)]
struct TokenResponse {
    token: Option<String>,
    access_token: Option<String>,
}

/// Errors of a registry.
#[derive(Deserialize)]
struct RefusalDocument {
    errors: Vec<RefusalEntry>,
}

#[derive(Deserialize)]
struct RefusalEntry {
    #[serde(default)]
    message: String,
}

impl RegistryClient {
    /// Creates a client for the repository of an image. A registry on this machine that does not speak TLS is asked in
    /// plain text.
    pub async fn connect(
        image: &ImageReference,
        credentials: Option<Credentials>,
        http: OutboundClient,
    ) -> anyhow::Result<RegistryClient> {
        let registry: Uri = format!("https://{}", image.registry).parse().with_context(|| image.registry.clone())?;
        let is_here = is_here(&registry);
        let mut origin = format!("https://{}", image.registry);
        if is_here && let Err(error) = probe(&http, &origin).await {
            let plain = format!("http://{}", image.registry);
            probe(&http, &plain).await.map_err(|_| error)?;
            origin = plain;
        }
        Ok(RegistryClient { http, image: image.clone(), origin, is_here, credentials, authorization: None })
    }

    /// Requests a manifest by tag or digest.
    pub async fn open_manifest(&mut self, version: &str) -> anyhow::Result<Response<OutboundBody>> {
        let accept = HeaderValue::from_str(&MEDIA_TYPES.join(", "))?;
        self.get(&format!("manifests/{version}"), &HeaderMap::from_iter([(ACCEPT, accept)])).await
    }

    /// Requests a blob from this byte on; returns its content, and the byte with which that begins, which may be an
    /// earlier one: not every registry continues.
    pub async fn open_blob(&mut self, digest: &Digest, from: u64) -> anyhow::Result<(OutboundBody, u64)> {
        let accept = HeaderValue::from_static("application/octet-stream, */*");
        let mut headers = HeaderMap::from_iter([(ACCEPT, accept)]);
        if from > 0 {
            headers.insert(RANGE, HeaderValue::from_str(&format!("bytes={from}-"))?);
        }
        let response = self.get(&format!("blobs/{digest}"), &headers).await?;
        if response.status() == StatusCode::OK {
            return Ok((response.into_body(), 0));
        }
        let begin = parse_begin(response.headers()).filter(|begin| *begin <= from);
        let begin = begin.with_context(|| format!("{} continues {digest} elsewhere", self.image.registry))?;
        Ok((response.into_body(), begin))
    }

    /// Requests a document of the repository, or the range in the headers, logging in if that is needed.
    async fn get(&mut self, path: &str, headers: &HeaderMap) -> anyhow::Result<Response<OutboundBody>> {
        let url: Uri = format!("{}/v2/{}/{path}", self.origin, self.image.repository).parse()?;
        let mut response = self.follow(url.clone(), headers).await?;
        // A token may be valid for less time than a large layer takes.
        if response.status() == StatusCode::UNAUTHORIZED {
            self.authorization = Some(self.log_in(response.headers()).await?);
            response = self.follow(url, headers).await?;
        }
        let is_part = response.status() == StatusCode::PARTIAL_CONTENT && headers.contains_key(RANGE);
        if response.status() == StatusCode::OK || is_part {
            return Ok(response);
        }
        Err(self.to_refusal(response).await)
    }

    /// Sends a request and follows redirects. Another server is not told who asks.
    async fn follow(&self, mut url: Uri, headers: &HeaderMap) -> anyhow::Result<Response<OutboundBody>> {
        for _ in 0..=MOST_REDIRECTS {
            let is_own = url.to_string().starts_with(&format!("{}/", self.origin));
            let mut request = get_request(&url);
            for (name, value) in headers {
                request = request.header(name, value);
            }
            if let Some(authorization) = self.authorization.as_ref().filter(|_| is_own) {
                request = request.header(AUTHORIZATION, authorization);
            }
            let response = self.http.open(request.body(Full::default())?).await?;
            if !response.status().is_redirection() {
                return Ok(response);
            }
            url = self.find_target(&url, response.headers())?;
        }
        bail!("{} redirects more than {MOST_REDIRECTS} times", self.image.registry)
    }

    /// Returns the address that a redirect leads to.
    fn find_target(&self, from: &Uri, headers: &HeaderMap) -> anyhow::Result<Uri> {
        let registry = &self.image.registry;
        let location = headers.get(LOCATION).and_then(|location| location.to_str().ok());
        let location = location.with_context(|| format!("{registry} redirects to nowhere"))?;
        let is_path = location.starts_with('/') && !location.starts_with("//");
        let origin = is_path.then(|| format!("{}://{}", from.scheme_str().unwrap_or("https"), host_and_port(from)));
        let target: Uri = format!("{}{location}", origin.unwrap_or_default())
            .parse()
            .with_context(|| format!("{registry} redirects to {location:?}"))?;
        self.check_elsewhere(&target)?;
        Ok(target)
    }

    /// Checks an address that the registry names: by HTTPS, and nothing on this machine unless the registry is here.
    fn check_elsewhere(&self, target: &Uri) -> anyhow::Result<()> {
        let registry = &self.image.registry;
        ensure!(self.is_here || !is_here(target), "{registry} names an address on this machine, {target}");
        outbound::find_server(target).map(drop).with_context(|| format!("{registry} names an address to ask"))
    }

    /// Logs in by what the registry asks for and returns the value of `Authorization`.
    async fn log_in(&self, headers: &HeaderMap) -> anyhow::Result<HeaderValue> {
        let values = headers.get_all(WWW_AUTHENTICATE).iter().filter_map(|value| value.to_str().ok());
        let challenges = parse_challenges(values);
        let bearer = challenges.iter().find_map(|challenge| match challenge {
            Challenge::Bearer { realm, service } => Some((realm, service.as_deref())),
            Challenge::Basic => None,
        });
        match (bearer, &self.credentials) {
            (Some((realm, service)), _) => self.request_token(realm, service).await,
            (None, Some(credentials)) if challenges.contains(&Challenge::Basic) => credentials.authorization(),
            (None, None) if challenges.contains(&Challenge::Basic) => bail!(
                "{registry} asks for a password; give a user name with --user, or log in: podman login {registry}",
                registry = self.image.registry
            ),
            _ => bail!("{} asks for a log-in of another kind than passwords and tokens", self.image.registry),
        }
    }

    /// Requests a token for pulling this repository, whatever scope the registry asks for.
    async fn request_token(&self, realm: &str, service: Option<&str>) -> anyhow::Result<HeaderValue> {
        let scope = format!("repository:{}:pull", self.image.repository);
        let mark = if realm.contains('?') { '&' } else { '?' };
        let mut url = format!("{realm}{mark}scope={}", percent_encode(&scope));
        if let Some(service) = service {
            url += &format!("&service={}", percent_encode(service));
        }
        let url: Uri = url.parse().with_context(|| format!("{} names a token server", self.image.registry))?;
        self.check_elsewhere(&url)?;
        let mut request = get_request(&url);
        if let Some(credentials) = &self.credentials {
            request = request.header(AUTHORIZATION, credentials.authorization()?);
        }
        let answer = self.http.send(request.body(Full::default())?).await?;
        let server = host_and_port(&url);
        ensure!(
            answer.status() == StatusCode::OK,
            "{server} gives no token for {}: {}{}; check the user name and the password (--user, or podman login {})",
            self.image,
            answer.status(),
            describe_refusal(answer.body()),
            self.image.registry
        );
        let answer: TokenResponse =
            serde_json::from_slice(answer.body()).with_context(|| format!("{server} answers with no token"))?;
        let token = answer.token.or(answer.access_token).filter(|token| !token.is_empty());
        let token = token.with_context(|| format!("{server} answers with no token"))?;
        let mut value = HeaderValue::from_str(&format!("Bearer {token}"))?;
        value.set_sensitive(true);
        Ok(value)
    }

    /// Describes a response that is no success.
    async fn to_refusal(&self, response: Response<OutboundBody>) -> anyhow::Error {
        let status = response.status();
        let mut body = response.into_body();
        let mut text = Vec::new();
        while let Ok(Some(chunk)) = body.next_chunk().await {
            text.extend_from_slice(&chunk);
            if text.len() > LARGEST_REFUSAL {
                break;
            }
        }
        let (image, said) = (&self.image, describe_refusal(&text));
        let next = match status {
            StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN => {
                format!("; check the user name and the password (--user, or podman login {})", image.registry)
            }
            StatusCode::NOT_FOUND => "; check its name and its tag".to_owned(),
            StatusCode::TOO_MANY_REQUESTS => "; try again later, or with a user name (--user)".to_owned(),
            _ => String::new(),
        };
        anyhow!("{} refuses {image}: {status}{said}{next}", image.registry)
    }
}

/// Asks a server whether it is a registry; any answer by HTTP will do.
async fn probe(http: &OutboundClient, origin: &str) -> Result<(), outbound::Error> {
    let url: Uri = format!("{origin}/v2/").parse().map_err(|_| outbound::Error::NoAddress(origin.to_owned()))?;
    let request = get_request(&url).body(Full::default());
    let request: Request<Full<Bytes>> = request.map_err(|_| outbound::Error::NoAddress(origin.to_owned()))?;
    http.open(request).await.map(drop)
}

fn get_request(url: &Uri) -> hyper::http::request::Builder {
    Request::get(url).header(USER_AGENT, NAME)
}

/// Returns the first byte of a partial response (RFC 9110, section 14.4).
fn parse_begin(headers: &HeaderMap) -> Option<u64> {
    let range = headers.get(CONTENT_RANGE)?.to_str().ok()?.strip_prefix("bytes ")?;
    range.split_once('-')?.0.parse().ok()
}

/// Returns whether an address is on this machine.
fn is_here(url: &Uri) -> bool {
    let host = url.host().unwrap_or_default();
    is_loopback_host(host.trim_start_matches('[').trim_end_matches(']'))
}

fn host_and_port(url: &Uri) -> &str {
    url.authority().map_or("", |authority| authority.as_str())
}

/// Returns the message of a refusal as one line in parentheses; empty if it has none.
fn describe_refusal(body: &[u8]) -> String {
    let document = serde_json::from_slice::<RefusalDocument>(body).ok();
    let message = document.and_then(|document| Some(document.errors.into_iter().next()?.message));
    let plain = |text: String| text.chars().filter(|c| !c.is_control()).take(LONGEST_REFUSAL).collect::<String>();
    match message.map(plain).filter(|text| !text.is_empty()) {
        Some(text) => format!(" ({text})"),
        None => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client(registry: &str) -> RegistryClient {
        let image: ImageReference = format!("{registry}/ros").parse().expect("a reference");
        RegistryClient {
            http: OutboundClient::new(None, NOBODY_TRUSTED),
            origin: format!("https://{registry}"),
            is_here: is_here(&format!("https://{registry}").parse().expect("an address")),
            image,
            credentials: None,
            authorization: None,
        }
    }

    #[test]
    fn a_registry_elsewhere_does_not_lead_to_servers_of_this_machine() {
        let target = |registry: &str, location: &str| {
            let headers = HeaderMap::from_iter([(LOCATION, HeaderValue::from_str(location).expect("a header"))]);
            let from = format!("https://{registry}/v2/ros/blobs/x").parse().expect("an address");
            client(registry).find_target(&from, &headers).map(|target| target.to_string())
        };
        for location in
            ["https://localhost/x", "http://127.0.0.1:9090/api", "https://[::1]/", "http://cdn.example.org/"]
        {
            let refused = target("registry.example.org", location).expect_err(location);
            assert!(refused.to_string().contains("registry.example.org names an address"), "{refused:#}");
        }
        let led = target("registry.example.org", "https://cdn.example.org/x?sig=y").expect("elsewhere");
        assert_eq!(led, "https://cdn.example.org/x?sig=y");
        assert_eq!(target("registry.example.org:5000", "/y").expect("a path"), "https://registry.example.org:5000/y");
        assert_eq!(target("localhost", "http://127.0.0.1:9090/x").expect("here"), "http://127.0.0.1:9090/x");
    }

    #[test]
    fn refusals_are_told_in_one_line() {
        let told = |text: &str| describe_refusal(text.as_bytes());
        assert_eq!(told("{\"errors\":[{\"code\":\"X\",\"message\":\"a\\u001bb\"},{}]}"), " (ab)");
        for nothing in ["", "<html>", "{\"errors\":[]}", "{\"errors\":[{}]}"] {
            assert_eq!(told(nothing), "");
        }
        let long = format!("{{\"errors\":[{{\"message\":{:?}}}]}}", "x".repeat(10_000));
        assert_eq!(told(&long).len(), LONGEST_REFUSAL + 3);
    }
}
