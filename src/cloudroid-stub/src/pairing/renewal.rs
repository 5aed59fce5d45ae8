//! Renews the robot's certificate, at two thirds of its life, over a connection that shows it. The stubs of a robot do it one at a
//! time, and each takes what another has brought.

use std::time::Duration;

use anyhow::{Context, bail};
use serde_json::json;
use tokio::time::sleep;

use super::key::Key;
use super::of;
use super::own::{Certificate, Own, now};
use crate::address::Address;
use crate::config::Config;
use crate::http;
use crate::resolver;

/// It is looked at least so often whether there is anything to renew: a robot may be paired, or its clock be set, while the stub runs.
const LATEST: Duration = Duration::from_secs(600);
/// After a renewal that failed: a twelfth of the certificate's life, between these.
const SOONEST: Duration = Duration::from_millis(200);
const PAUSES: u32 = 12;

/// Renews the certificate for the server of a configuration whenever it is time; never comes back.
pub async fn keep_renewed(config: Config) {
    let Some((own, address)) = of(&config) else {
        return std::future::pending().await;
    };
    let mut told = String::new();
    loop {
        let certificate = match own.certificate(&address) {
            Ok(Some(certificate)) => certificate,
            // What is wrong with it is said where the server is connected to.
            Ok(None) | Err(_) => {
                sleep(LATEST).await;
                continue;
            }
        };
        let due = certificate.due(now());
        if due > Duration::ZERO {
            sleep(due.min(LATEST)).await;
            continue;
        }
        match renew(&config, &own, &address, &certificate).await {
            Ok(renewed) => {
                told.clear();
                if renewed {
                    tracing::info!(
                        "the certificate of this robot was renewed by {}",
                        config.server
                    );
                }
            }
            Err(error) => {
                let words = format!("{error:#}");
                if words != told {
                    tracing::warn!(
                        "the certificate of this robot cannot be renewed: {words}; trying again"
                    );
                    told = words;
                }
                sleep((certificate.lifetime() / PAUSES).clamp(SOONEST, LATEST)).await;
            }
        }
    }
}

/// Asks for another certificate; false where another stub does, or has.
async fn renew(
    config: &Config,
    own: &Own,
    address: &Address,
    old: &Certificate,
) -> anyhow::Result<bool> {
    let Some(_alone) = own.lock(address) else {
        sleep(SOONEST).await;
        return Ok(false);
    };
    if own.certificate(address)?.as_ref() != Some(old) {
        return Ok(false);
    }
    let key = Key::read(&own.key())?;
    let server = http::Server {
        ip: resolver::resolve(&address.host).await?,
        address: address.clone(),
        trust: config.trust()?,
        only: None,
    };
    let asks = json!({ "request": key.request(&old.robot)? });
    let answer = http::post(&server, "/api/v1/renew", &asks).await;
    let answer = answer.map_err(|error| match crate::stream::refused_certificate(&error) {
        Some(words) => anyhow::anyhow!("{} refuses this robot: {words}", config.server),
        None => error.into(),
    })?;
    if answer.status != 200 {
        bail!(
            "{} answers {}: {}",
            config.server,
            answer.status,
            answer.words()
        );
    }
    let new = Certificate::read(&answer.body)
        .with_context(|| format!("what {} answers is no certificate", config.server))?;
    own.keep(address, &new)?;
    Ok(true)
}
