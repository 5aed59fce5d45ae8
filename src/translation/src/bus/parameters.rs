//! Parameters between a robot of one ROS and a servant of the other. In ROS 1 all nodes share the parameters of the
//! Master; in ROS 2 each node has its own. So the node `/camera/see` with the parameter `gains.p` of ROS 2 is the key
//! `/camera/see/gains/p` of ROS 1.
//!
//! ```text
//!  robot ROS 1 ── GlobalParameters ▶ ParameterServerView ── NodeParameters ▶ servant ROS 2
//!  robot ROS 2 ── NodeParameters ▶ NodeParameterView ── GlobalParameters, dynamic_reconfigure ▶ servant ROS 1
//! ```
//! What a value of one ROS is in the other stands in the module `values`. What cannot be carried is refused in words,
//! or, where nobody waits for an answer, left out with a line in the log.

mod kept;
mod launch;
mod names;
mod nodes;
mod reconfigure;
mod refusals;
mod server;
mod services;
mod values;

use std::collections::BTreeMap;
use std::sync::Arc;

use budget::Budget;
use ros::bus::{Bus, BusError, GlobalParameters, NodeParameters, ParameterKind, RosVersion};

pub use launch::{LeftOutParameters, TranslatedLaunch};
pub use nodes::NodeParameterView;
pub use server::ParameterServerView;
pub use services::ParameterServices;
pub use values::ParameterRefusal;

/// The parameters of a servant in the terms of a robot of the other ROS.
pub enum TranslatedParameters {
    /// Of a servant of ROS 2, for a robot of ROS 1.
    Server(ParameterServerView),
    /// Of a servant of ROS 1, for a robot of ROS 2.
    Nodes(NodeParameterView),
}

impl TranslatedParameters {
    /// Creates the parameters of the servant with this bus. What is kept for the robot is charged to `budget`.
    pub fn new(inner: &Arc<dyn Bus>, budget: Budget) -> Self {
        match inner.version() {
            RosVersion::One => Self::Nodes(NodeParameterView::new(Arc::clone(inner))),
            RosVersion::Two => Self::Server(ParameterServerView::new(Arc::clone(inner), budget)),
        }
    }

    /// Returns the parameters that all nodes share, for a robot of ROS 1.
    pub fn global(&self) -> Result<&dyn GlobalParameters, BusError> {
        match self {
            Self::Server(server) => Ok(server),
            Self::Nodes(_) => Err(BusError::NotOffered("global parameters")),
        }
    }

    /// Returns access to the parameters of individual nodes, for a robot of ROS 2.
    pub fn of_nodes(&self) -> Result<&dyn NodeParameters, BusError> {
        match self {
            Self::Server(_) => Err(BusError::NotOffered("parameters of nodes")),
            Self::Nodes(nodes) => Ok(nodes),
        }
    }

    /// Returns what the robot's node of this absolute name is started with. `argv` is in the spelling of the servant's
    /// ROS. At a servant of ROS 2 the arguments then include the parameters that stand below the node's name at the
    /// robot's Master; at a servant of ROS 1 they are to be set before the node starts. `kinds`: types of the node's
    /// parameters, as far as they are known.
    pub fn prepare_launch(
        &self,
        node: &str,
        argv: &[String],
        kinds: &BTreeMap<String, ParameterKind>,
    ) -> TranslatedLaunch {
        match self {
            Self::Server(server) => {
                let (private, simulated) = server.launch_parameters(node);
                launch::for_ros2(argv, &private, simulated, kinds)
            }
            Self::Nodes(_) => launch::for_ros1(node, argv),
        }
    }
}
