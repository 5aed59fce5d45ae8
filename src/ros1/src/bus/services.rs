//! Services that this node serves.

use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use ros_bus::{BusError, Digest, ServiceHandler, ServiceType};
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::timeout;

use super::registrar::Kind;
use super::server::refuse;
use super::state::{Ros1BusState, ServiceEntry};
use crate::tcpros::{Error, Header, serve_calls};

/// Time for a caller to accept a header.
const TAKE: Duration = Duration::from_secs(10);

/// Field of a server's header that contains its label.
pub(super) const LABEL: &str = "cloudroid";

impl ServiceEntry {
    pub(super) fn has_ended(&self) -> bool {
        *self.ended.borrow() || self.ended.has_changed().is_err()
    }
}

/// Serves until the guard is dropped.
pub(super) async fn serve(
    bus: &Arc<Ros1BusState>,
    name: &str,
    service_type: ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> Result<Box<dyn Send + Sync>, BusError> {
    let (ending, ended) = watch::channel(false);
    let served = Arc::new(ServiceEntry { service_type, handler, ended });
    {
        let mut services = bus.services.lock();
        if services.contains_key(name) {
            return Err(BusError::AlreadyServed(name.to_owned()));
        }
        services.insert(name.to_owned(), served.clone());
        let type_name = served.service_type.name.as_str();
        bus.registrar.set_wanted(Kind::Service, name, Some(type_name));
    }
    let guard = ServiceGuard { bus: bus.clone(), name: name.to_owned(), served, ending };
    bus.registrar.sync(Kind::Service, name, false).await?;
    Ok(Box::new(guard))
}

struct ServiceGuard {
    bus: Arc<Ros1BusState>,
    name: String,
    served: Arc<ServiceEntry>,
    ending: watch::Sender<bool>,
}

impl Drop for ServiceGuard {
    fn drop(&mut self) {
        self.ending.send_replace(true);
        {
            let mut services = self.bus.services.lock();
            let current = services.get(&self.name);
            if !current.is_some_and(|served| Arc::ptr_eq(served, &self.served)) {
                return;
            }
            services.remove(&self.name);
            self.bus.registrar.set_wanted(Kind::Service, &self.name, None);
        }
        let (bus, name) = (self.bus.clone(), self.name.clone());
        self.bus.spawn(async move {
            let _ = bus.registrar.sync(Kind::Service, &name, false).await;
        });
    }
}

/// Serves one caller whose header has been read.
pub(super) async fn serve_caller(
    bus: &Arc<Ros1BusState>,
    name: &str,
    header: &Header,
    mut stream: TcpStream,
    buffer: BytesMut,
) -> Result<(), Error> {
    let served = bus.services.lock().get(name).cloned();
    let Some(served) = served.or_else(|| bus.lending.active_service(name)) else {
        return refuse(stream, &format!("{} does not serve {name}", bus.node)).await;
    };
    let ours = &served.service_type;
    let asked = Digest::from(header.get("md5sum").unwrap_or("*"));
    if !asked.is_compatible_with(&ours.digest) {
        let reason = format!(
            "client wants service {name} to have md5sum {asked}, but it has {}; dropping connection",
            ours.digest
        );
        return refuse(stream, &reason).await;
    }
    let mut answer = Header::new([
        ("callerid", bus.node.as_str()),
        ("service", name),
        ("type", &ours.name),
        ("md5sum", ours.digest.as_str()),
        ("request_type", &format!("{}Request", ours.name)),
        ("response_type", &format!("{}Response", ours.name)),
    ]);
    if let Some(label) = bus.label.get() {
        answer = answer.with_field(LABEL, label);
    }
    match timeout(TAKE, answer.write(&mut stream)).await {
        Ok(written) => written?,
        Err(_) => return Ok(()),
    }
    if header.flag("probe") {
        return Ok(stream.shutdown().await?);
    }
    let caller = header.get("callerid").unwrap_or("unknown");
    let handler = served.handler.for_type(&asked);
    serve_calls(
        stream,
        buffer,
        (caller, header.flag("persistent")),
        handler.as_deref().unwrap_or(&*served.handler),
        bus.frames.clone(),
        served.ended.clone(),
    )
    .await
}
