//! Exec sessions: started for a daemon, and ended when it leaves them.

use std::os::fd::{AsRawFd, OwnedFd};

use init::{Scope, StartRequest};

use super::Driver;
use crate::exec::ExecSpec;
use crate::shim::command_error::{CommandError, StartError};
use crate::shim::execs::ExecTableError;

impl Driver {
    /// Starts a session's program; returns the number of the start. `descriptors` are the session's socket and its
    /// streams.
    pub(super) async fn start_exec(
        &mut self,
        spec: &ExecSpec,
        mut descriptors: Vec<OwnedFd>,
    ) -> Result<u32, CommandError> {
        let count = if spec.terminal { 2 } else { 4 };
        if descriptors.len() != count {
            return Err(ExecTableError::NoStreams.into());
        }
        let streams = descriptors.split_off(1);
        let number = self.nodes.allocate_number();
        for socket in descriptors {
            self.execs.add(number, socket)?;
        }
        let mut environment = self.begun.launch.spec.environment.clone();
        environment.extend(spec.environment.clone());
        let environment: Vec<String> = environment.iter().map(|(name, value)| format!("{name}={value}")).collect();
        let request = StartRequest { id: number, directory: "", argv: &spec.argv, environment: &environment };
        let raw: Vec<_> = streams.iter().map(AsRawFd::as_raw_fd).collect();
        if let Err(error) = self.link.start(&request, &raw).await {
            self.execs.remove_starting(number);
            return Err(StartError::from(error).into());
        }
        Ok(number)
    }

    /// Kills a session's program with all that it has started, unless it has ended.
    pub(super) async fn end_exec(&self, number: u32) {
        if let Some(pid) = self.execs.supervisor(number) {
            // Fails if init is gone: then the program is, too.
            let _ = self.link.signal(pid, libc::SIGTERM, Scope::Process).await;
        }
    }
}
