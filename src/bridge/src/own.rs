//! Services that the bridge answers itself if no node of the servant does: those of rosapi and tf.

use crate::own_service::OwnService;
use crate::{rosapi, tf};

/// Finds the service with this absolute name.
pub(crate) fn find_own_service(name: &str) -> Option<Box<dyn OwnService>> {
    if let Some(service) = rosapi::RosapiService::find(name) {
        return Some(Box::new(service));
    }
    (name == tf::SERVICE).then(|| Box::new(tf::RepublishTfs) as Box<dyn OwnService>)
}
