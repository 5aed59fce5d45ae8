//! The HTTP API beside its description, as a program sees it that nobody here wrote.

use std::process::Command;
use std::time::Duration;

use anyhow::{Context, ensure};
use support::deployer::run;
use support::world::{ADDER, world};
use support::{Verdict, binaries};

use crate::access::token;

/// What is wrong anywhere: an answer of 500 and above, or a status, type or value that the document does not have.
const CHECKS: &str = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance";
/// Seconds until an answer is there, on a busy machine.
const ANSWERED: Duration = Duration::from_secs(60);

pub fn every_answer_is_as_the_document_says() -> Verdict {
    let daemon = world().own("described").start()?;
    let deployer = daemon.deployer();
    deployer.pushes("adder_py", ADDER.arguments)?.succeeded()?;
    let admin = token(&daemon, &["chief", "--role", "admin"])?;
    let viewer = token(&daemon, &["looks", "--role", "viewer", "--service", "*"])?;
    let place = world().directory("described")?;
    for (who, bearer, most) in [("viewer", viewer, "3"), ("admin", admin.clone(), "10")] {
        let mut schemathesis = Command::new(binaries::readers().join("schemathesis"));
        let hooks = binaries::checkout().join("tests/readers");
        schemathesis
            .current_dir(place.path())
            .env("PYTHONPATH", &hooks)
            .env("SCHEMATHESIS_HOOKS", "hooks")
            .args(["--no-color", "run"])
            .arg(format!("http://{}/api/v1/openapi.json", daemon.address))
            .args(["--header", &format!("Authorization: Bearer {bearer}")])
            .args(["--checks", CHECKS, "--phases", "examples,coverage,fuzzing"])
            .args([
                "--max-examples",
                most,
                "--seed",
                "1",
                "--continue-on-failure",
            ])
            .args(["--request-timeout", &ANSWERED.as_secs().to_string()])
            .args(["--generation-database", "none", "--warnings", "off"])
            // These go on for as long as somebody listens, or somebody else does what they wait for.
            .args(["--exclude-operation-id", "stream"])
            .args(["--exclude-operation-id", "followEvents"])
            .args(["--exclude-operation-id", "shadow"]);
        let outcome = run(&mut schemathesis)?;
        let said = outcome.succeeded().with_context(|| who.to_owned())?.stdout;
        let tested = said
            .lines()
            .find_map(|line| line.trim().strip_prefix("Tested: "));
        let tested: usize = tested.context("a count")?.trim().parse()?;
        ensure!(tested > 50, "{who}: {said}");
    }
    // It was not turned away half-way.
    let bearer = format!("Bearer {admin}");
    let (status, _) = daemon.request("GET", "/api/v1/status", &[("Authorization", &bearer)])?;
    ensure!(status == 200, "{status}");
    Ok(())
}
