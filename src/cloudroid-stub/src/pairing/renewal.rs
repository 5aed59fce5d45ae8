//! Renews the robot's certificate, at two thirds of its validity, over a connection that presents it. The stubs of a
//! robot take turns, and each uses the certificate that another has fetched.

use std::time::Duration;

use anyhow::{Context, bail};
use serde_json::json;
use tokio::time::sleep;

use super::key::RobotKey;
use super::locate_identity;
use super::own::{IdentityDirectory, PairedCertificate, now};
use crate::address::Address;
use crate::config::Config;
use crate::http;
use crate::resolver;

/// Maximum interval between checks: while the stub runs, the robot may be paired or its clock be set.
const LATEST: Duration = Duration::from_secs(600);
/// Delay after a failed renewal: a twelfth of the certificate's validity, at least this and at most `LATEST`.
const SOONEST: Duration = Duration::from_millis(200);
const PAUSES: u32 = 12;

/// Renews the certificate for the configured server whenever it is due; never returns.
pub async fn run_renewal(config: Config) {
    let Some((own, address)) = locate_identity(&config) else {
        return std::future::pending().await;
    };
    let mut told = String::new();
    loop {
        let certificate = match own.load_certificate(&address) {
            Ok(Some(certificate)) => certificate,
            // Problems with it are reported when the server is connected to.
            Ok(None) | Err(_) => {
                sleep(LATEST).await;
                continue;
            }
        };
        let due = certificate.renewal_delay(now());
        if due > Duration::ZERO {
            sleep(due.min(LATEST)).await;
            continue;
        }
        match renew(&config, &own, &address, &certificate).await {
            Ok(renewed) => {
                told.clear();
                if renewed {
                    tracing::info!("the certificate of this robot was renewed by {}", config.server);
                }
            }
            Err(error) => {
                let words = format!("{error:#}");
                if words != told {
                    tracing::warn!("cannot renew this robot's certificate: {words}; trying again");
                    told = words;
                }
                sleep((certificate.lifetime() / PAUSES).clamp(SOONEST, LATEST)).await;
            }
        }
    }
}

/// Requests a new certificate; returns false if another stub does so, or has done so.
async fn renew(
    config: &Config,
    own: &IdentityDirectory,
    address: &Address,
    old: &PairedCertificate,
) -> anyhow::Result<bool> {
    let Some(_alone) = own.lock_renewal(address) else {
        sleep(SOONEST).await;
        return Ok(false);
    };
    if own.load_certificate(address)?.as_ref() != Some(old) {
        return Ok(false);
    }
    let key = RobotKey::read(&own.key_path())?;
    let server = http::HttpServer {
        ip: resolver::resolve(&address.host).await?,
        address: address.clone(),
        trust: config.trust()?,
        only: None,
    };
    let asks = json!({ "request": key.certificate_request(&old.robot)? });
    let answer = http::post(&server, "/api/v1/renew", &asks).await;
    let answer = answer.map_err(|error| match crate::stream::certificate_refusal(&error) {
        Some(words) => anyhow::anyhow!("{} refuses this robot: {words}", config.server),
        None => error.into(),
    })?;
    if answer.status != 200 {
        bail!("{} answers {}: {}", config.server, answer.status, answer.problem_text());
    }
    let new = PairedCertificate::read(&answer.body)
        .with_context(|| format!("the response of {} is not a certificate", config.server))?;
    own.store_certificate(address, &new)?;
    Ok(true)
}
