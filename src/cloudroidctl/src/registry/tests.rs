use std::collections::BTreeMap;
use std::io::Read;
use std::sync::{Arc, Mutex};

use http_body_util::BodyExt;
use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use super::*;

/// A request as a registry sees it.
struct Asked {
    path: String,
    authorization: Option<String>,
    /// First byte that is asked for.
    begin: usize,
}

/// A registry on this machine that answers each request by a function.
struct FakeRegistry {
    address: String,
    paths: Arc<Mutex<Vec<String>>>,
}

impl FakeRegistry {
    async fn start(answer: impl Fn(&Asked) -> Vec<u8> + Send + Sync + 'static) -> FakeRegistry {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound").to_string();
        let paths = Arc::new(Mutex::new(Vec::new()));
        let (answer, seen) = (Arc::new(answer), Arc::clone(&paths));
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                let (answer, seen) = (Arc::clone(&answer), Arc::clone(&seen));
                tokio::spawn(async move {
                    if let Some((asked, mut stream)) = read_request(stream).await {
                        seen.lock().expect("no panic").push(asked.path.clone());
                        // The client closes the connection once it has read enough.
                        let _ = stream.write_all(&answer(&asked)).await;
                    }
                });
            }
        });
        FakeRegistry { address, paths }
    }

    fn image(&self, version: &str) -> ImageReference {
        format!("docker://{}/lab/ros{version}", self.address).parse().expect("a reference")
    }

    fn paths(&self) -> Vec<String> {
        self.paths.lock().expect("no panic").clone()
    }
}

/// Reads the head of a request; `None` for what is no HTTP, such as the beginning of TLS.
async fn read_request(mut stream: TcpStream) -> Option<(Asked, TcpStream)> {
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        if stream.read_buf(&mut head).await.ok()? == 0 || !head.starts_with(b"G") {
            return None;
        }
    }
    let head = String::from_utf8(head).ok()?;
    let path = head.split(' ').nth(1)?.to_owned();
    let authorization = head.lines().find_map(|line| line.strip_prefix("authorization: ")).map(str::to_owned);
    let range = head.lines().find_map(|line| line.strip_prefix("range: bytes=")?.strip_suffix('-'));
    let begin = range.map_or(0, |begin| begin.parse().expect("a number"));
    Some((Asked { path, authorization, begin }, stream))
}

fn answer(status: u16, header: &str, body: &[u8]) -> Vec<u8> {
    let length = body.len();
    let mut answer = format!("HTTP/1.1 {status} X\r\ncontent-length: {length}\r\n{header}\r\n").into_bytes();
    answer.extend_from_slice(body);
    answer
}

fn challenge(value: &str) -> Vec<u8> {
    answer(401, &format!("www-authenticate: {value}\r\n"), b"{\"errors\":[{\"message\":\"log in\"}]}")
}

/// An image with one layer.
#[derive(Clone)]
struct TestImage {
    layer: Vec<u8>,
    manifest: Vec<u8>,
    index: Vec<u8>,
}

const CONFIG: &[u8] = b"{\"architecture\":\"amd64\"}";

fn describe(bytes: &[u8]) -> Value {
    json!({ "digest": Digest::compute(bytes).to_string(), "size": bytes.len() })
}

impl TestImage {
    fn new() -> TestImage {
        let layer: Vec<u8> = (0..200_000_u32).map(|number| (number % 251) as u8).collect();
        let layers = [describe(&layer), describe(&layer)];
        let manifest = json!({ "schemaVersion": 2, "config": describe(CONFIG), "layers": layers }).to_string();
        let mut entry = describe(manifest.as_bytes());
        entry["platform"] = json!({ "os": "linux", "architecture": "amd64" });
        let index = json!({ "schemaVersion": 2, "manifests": [entry] }).to_string();
        TestImage { layer, manifest: manifest.into_bytes(), index: index.into_bytes() }
    }

    /// Answers as a registry that has this image as `lab/ros:jazzy` would.
    fn answer(&self, path: &str) -> Vec<u8> {
        let Some(name) = path.strip_prefix("/v2/lab/ros/") else {
            return answer(200, "", b"{}");
        };
        let by_digest = |bytes: &[u8]| name.ends_with(Digest::compute(bytes).hex());
        let documents = [&self.manifest[..], CONFIG, &self.layer];
        match documents.into_iter().find(|bytes| by_digest(bytes)) {
            Some(bytes) => answer(200, "", bytes),
            None if name == "manifests/jazzy" => answer(200, "", &self.index),
            None => answer(404, "", b"{\"errors\":[{\"message\":\"no\\nsuch tag\"}]}"),
        }
    }
}

async fn pull(image: &ImageReference, credentials: Option<Credentials>) -> anyhow::Result<Vec<u8>> {
    let (body, pulling) = read_manifest(image, credentials, "amd64").await?.into_body(|_| ());
    match body.collect().await {
        Ok(whole) => Ok(whole.to_bytes().to_vec()),
        Err(_) => Err(pulling.into_error().expect("the error of pulling")),
    }
}

fn lab() -> Option<Credentials> {
    Some(Credentials::new("lab".to_owned(), "secret".to_owned()).expect("a user"))
}

const PASSWORD: &str = "Basic bGFiOnNlY3JldA==";

#[tokio::test]
async fn an_image_becomes_a_layout_with_each_blob_once() {
    let image = TestImage::new();
    let served = image.clone();
    let registry = FakeRegistry::start(move |asked| served.answer(&asked.path)).await;
    let reference = registry.image(":jazzy");
    let archive = pull(&reference, None).await.expect("pulled");
    let mut files = BTreeMap::new();
    for entry in tar::Archive::new(&archive[..]).entries().expect("a tar") {
        let mut entry = entry.expect("an entry");
        let name = entry.path().expect("a path").display().to_string();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).expect("data");
        files.insert(name, bytes);
    }
    assert_eq!(files.len(), 5, "{:?}", files.keys());
    let index: Value = serde_json::from_slice(&files["index.json"]).expect("JSON");
    let entry = &index["manifests"][0];
    assert_eq!(entry["annotations"]["io.containerd.image.name"], reference.to_string());
    assert_eq!(entry["digest"], Digest::compute(&image.manifest).to_string());
    for blob in [&image.manifest[..], CONFIG, &image.layer] {
        assert_eq!(files[&format!("blobs/sha256/{}", Digest::compute(blob).hex())], blob);
    }
    assert!(archive.len().is_multiple_of(512) && archive.ends_with(&[0; 1024]));
}

#[tokio::test]
async fn a_token_is_fetched_with_the_password_and_a_redirect_tells_nobody_who_asks() {
    let image = TestImage::new();
    let store = image.clone();
    // Where the blobs are kept: a stranger, who refuses what a log-in would be.
    let elsewhere = FakeRegistry::start(move |asked| match asked.authorization {
        Some(_) => answer(400, "", b""),
        None => store.answer(&asked.path.replace("/kept/", "/v2/lab/ros/blobs/")),
    })
    .await;
    let (kept, served) = (elsewhere.address.clone(), image.clone());
    let own = Arc::new(Mutex::new(String::new()));
    let address = Arc::clone(&own);
    let registry = FakeRegistry::start(move |asked| {
        let own = address.lock().expect("no panic").clone();
        let (path, who) = (asked.path.as_str(), asked.authorization.as_deref());
        if path.starts_with("/token") {
            let is_good = who == Some(PASSWORD) && path.contains("scope=repository%3Alab%2Fros%3Apull");
            let text = if is_good { "{\"token\":\"t0ken\"}" } else { "{}" };
            return answer(200, "", text.as_bytes());
        }
        if who != Some("Bearer t0ken") {
            // The scope is for the registry to misuse.
            return challenge(&format!(
                "Bearer realm=\"http://{own}/token\",service=\"x y\",scope=\"repository:a:push\""
            ));
        }
        match path.rsplit_once("/blobs/sha256:") {
            Some((_, hex)) => answer(307, &format!("location: http://{kept}/kept/{hex}\r\n"), b""),
            None => served.answer(path),
        }
    })
    .await;
    own.lock().expect("no panic").clone_from(&registry.address);
    let archive = pull(&registry.image(":jazzy"), lab()).await.expect("pulled");
    assert!(archive.len() > image.layer.len());
    assert!(registry.paths().contains(&"/token?scope=repository%3Alab%2Fros%3Apull&service=x%20y".to_owned()));
    assert_eq!(elsewhere.paths().len(), 2, "config and layer");
}

#[tokio::test]
async fn a_password_is_sent_where_one_is_asked_for() {
    let image = TestImage::new();
    let registry = FakeRegistry::start(move |asked| match asked.authorization.as_deref() {
        Some(PASSWORD) => image.answer(&asked.path),
        _ => challenge("Basic realm=\"cloudroid\", charset=\"UTF-8\""),
    })
    .await;
    pull(&registry.image(":jazzy"), lab()).await.expect("pulled");
    let other = Credentials::new("lab".to_owned(), "guessed".to_owned()).expect("a user");
    for (credentials, words) in [(None, "asks for a password"), (Some(other), "401 Unauthorized (log in)")] {
        let refused = pull(&registry.image(":jazzy"), credentials).await.expect_err(words).to_string();
        assert!(refused.contains(words) && refused.contains("podman login"), "{refused}");
    }
}

#[tokio::test]
async fn what_differs_from_the_manifest_is_refused() {
    let image = TestImage::new();
    let layer = Digest::compute(&image.layer);
    let path = format!("/v2/lab/ros/blobs/{layer}");
    let mut changed = image.layer.clone();
    changed[100_000] ^= 1;
    let (longer, shorter) = ([&image.layer[..], b"x"].concat(), image.layer[1..].to_vec());
    let torn = answer(200, "", &image.layer)[..1000].to_vec();
    for (served, words) in [
        (answer(200, "", &changed), "has the content of"),
        (answer(200, "", &longer), "is longer than the 200000 bytes"),
        (answer(200, "", &shorter), "is 1 bytes shorter"),
        (torn, "cannot be read"),
        (answer(404, "", b"gone"), "404"),
        (answer(302, "location: /v2/lab/ros/blobs/again\r\n", b""), "404"),
        (answer(302, "", b""), "redirects to nowhere"),
        (answer(302, &format!("location: {path}\r\n"), b""), "redirects more than 5 times"),
        (answer(302, "location: http://192.0.2.1/x\r\n", b""), "plain text"),
        (answer(302, "location: file:///etc/shadow\r\n", b""), "file:///etc/shadow"),
        (answer(302, "location: //192.0.2.1/x\r\n", b""), "//192.0.2.1/x"),
    ] {
        let (image, path) = (image.clone(), path.clone());
        let registry = FakeRegistry::start(
            move |asked| {
                if asked.path == path { served.clone() } else { image.answer(&asked.path) }
            },
        )
        .await;
        let refused = pull(&registry.image(":jazzy"), None).await.expect_err(words);
        let refused = format!("{refused:#}");
        assert!(refused.contains(words) && refused.contains("cannot pull 127.0.0.1"), "{refused}");
    }
}

#[tokio::test]
async fn a_layer_whose_transfer_breaks_is_continued_or_fetched_again() {
    for (continues, expected) in [(true, vec![0, 90_000]), (false, vec![0, 90_000, 180_000])] {
        let (image, begins) = (TestImage::new(), Arc::new(Mutex::new(Vec::new())));
        let path = format!("/v2/lab/ros/blobs/{}", Digest::compute(&image.layer));
        let (served, asked_for) = (image.clone(), Arc::clone(&begins));
        let registry = FakeRegistry::start(move |asked| {
            if asked.path != path {
                return served.answer(&asked.path);
            }
            let mut asked_for = asked_for.lock().expect("no panic");
            asked_for.push(asked.begin);
            let begin = if continues { asked.begin } else { 0 };
            let part = &served.layer[begin..];
            let answer = match begin {
                0 => answer(200, "", part),
                _ => answer(206, &format!("content-range: bytes {begin}-199999/200000\r\n"), part),
            };
            // Each connection breaks later than the one before.
            let left_out = part.len().saturating_sub(90_000 * asked_for.len());
            answer[..answer.len() - left_out].to_vec()
        })
        .await;
        let pulled = Arc::new(Mutex::new(0));
        let counted = Arc::clone(&pulled);
        let found = read_manifest(&registry.image(":jazzy"), None, "amd64").await.expect("an image");
        let (body, _pulling) = found.into_body(move |bytes| *counted.lock().expect("no panic") += bytes);
        body.collect().await.expect("pulled");
        assert_eq!(*begins.lock().expect("no panic"), expected);
        assert_eq!(*pulled.lock().expect("no panic"), (CONFIG.len() + image.layer.len()) as u64, "each byte once");
    }
}

#[tokio::test]
async fn what_is_no_manifest_is_refused() {
    let image = TestImage::new();
    let wanted = format!("@{}", Digest::compute(&image.manifest));
    let mut changed = image.manifest.clone();
    changed.push(b' ');
    let nested = |digest: &Digest| json!({ "manifests": [{ "digest": digest.to_string(), "size": 1 }] }).to_string();
    let inner = nested(&Digest::compute(&image.index));
    let outer = nested(&Digest::compute(inner.as_bytes()));
    let large = vec![b' '; LARGEST_DOCUMENT as usize + 1];
    for (version, served, words) in [
        (wanted.as_str(), answer(200, "", &changed), "the registry gives sha256:"),
        (":jazzy", answer(200, "", &large), "larger than 4194304 bytes"),
        (":jazzy", answer(200, "", b"<html>"), "its manifest cannot be read"),
        (":jazzy", answer(200, "", outer.as_bytes()), "list of lists"),
        (":humble", image.answer("/v2/lab/ros/manifests/humble"), "404 Not Found (nosuch tag); check its name"),
        (":jazzy", answer(500, "", b"{\"errors\":[]}"), "500 Internal Server Error"),
        (":jazzy", challenge("Negotiate"), "a log-in of another kind"),
        (":jazzy", challenge("Bearer realm=\"http://192.0.2.1/token\""), "plain text"),
        (":jazzy", challenge("Bearer realm=\"https://user:word@192.0.2.1/token\""), "is no address of a server"),
        (":jazzy", challenge("Bearer realm=\"token\""), "names"),
    ] {
        let (image, inner) = (image.clone(), inner.clone());
        let registry = FakeRegistry::start(move |asked| {
            let digest = asked.path.rsplit('/').next().unwrap_or_default();
            if digest == Digest::compute(inner.as_bytes()).to_string() {
                answer(200, "", inner.as_bytes())
            } else if digest == Digest::compute(&image.index).to_string() {
                answer(200, "", &image.index)
            } else if asked.path.contains("/manifests/") {
                served.clone()
            } else {
                image.answer(&asked.path)
            }
        })
        .await;
        let refused = pull(&registry.image(version), lab()).await.expect_err(words);
        let refused = format!("{refused:#}");
        assert!(refused.contains(words), "{refused}");
    }
}

#[tokio::test]
async fn a_token_server_that_gives_none_is_named() {
    for (text, words) in [
        ("{\"errors\":[{\"message\":\"wrong password\"}]}", "gives no token for"),
        ("{}", "answers with no token"),
        ("{\"token\":\"\"}", "answers with no token"),
        ("{\"token\":\"a\\nb\"}", "failed to parse header value"),
    ] {
        let token = FakeRegistry::start(move |_| {
            let status = if text.contains("errors") { 401 } else { 200 };
            answer(status, "", text.as_bytes())
        })
        .await;
        let realm = format!("Bearer realm=\"http://{}/token\"", token.address);
        let registry = FakeRegistry::start(move |_| challenge(&realm)).await;
        let refused = pull(&registry.image(":jazzy"), lab()).await.expect_err(words);
        assert!(format!("{refused:#}").contains(words), "{refused:#}");
        assert_eq!(token.paths().len(), 1);
    }
}
