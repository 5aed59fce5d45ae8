//! Tests of what lines of the log say that they are about.

use super::*;

#[tokio::test]
async fn a_line_of_a_servants_task_says_which_servant_it_is_about() {
    let file = tempfile::NamedTempFile::new().expect("a file");
    let writer = Arc::new(file.reopen().expect("it exists"));
    let log = tracing_subscriber::fmt().with_writer(writer).with_ansi(false);
    // For all threads, whose tests write lines about servants of their own: what one thread does not record may be
    // disabled for all, until the next subscriber comes.
    tracing::subscriber::set_global_default(log.finish()).expect("no other test needs one");
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let lease = ready(&daemon, ServantRequest::new("greet", "r2d2")).await;
    let id = &lease.handle().id;
    let about = format!(" servant{{id=\"{id}\" service=\"greet\" robot=\"r2d2\"}}: ");
    let lines = std::fs::read_to_string(file.path()).expect("written");
    let mut of_servant = lines.lines().filter(|line| line.contains(&about));
    assert!(of_servant.any(|line| line.contains("is ready for r2d2")), "{lines}");
}
