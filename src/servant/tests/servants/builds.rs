//! The profiles in which packages are installed and compiled.

use std::os::unix::fs::MetadataExt;

use servant::container::Profile;
use servant::engine::ServantHandle;
use servant::rootfs::work_directory;

use crate::support::*;

#[tokio::test]
async fn installing_writes_the_root_and_changes_owners() {
    let world = World::new();
    let upper = world.path("upper");
    let mut spec = spec(vec![node("/chown", &["chown", "/usr/made", "33"])]);
    (spec.profile, spec.writable) = (Profile::Install, Some(upper.clone()));
    let servant = world.start(spec).await;
    assert_eq!(with_timeout(servant.wait_node("/chown")).await.unwrap().code, Some(0));
    let (first, _) = servant.uid_range();
    world.stop(servant).await;
    let made = std::fs::metadata(upper.join("usr/made")).unwrap();
    assert_eq!((made.uid(), made.gid()), (first + 33, first + 33), "what is written keeps the shifted ids");
    assert_eq!(std::fs::metadata(&upper).unwrap().uid(), first);
    assert!(!work_directory(&upper).exists());
}

#[tokio::test]
async fn compiling_writes_where_it_may_and_changes_no_owner() {
    let world = World::new();
    let upper = world.path("upper");
    let mut spec = spec(vec![
        node("/writes", &["write", "/usr/space/made"]),
        node("/gives", &["chown", "/usr/space/given", "0"]),
        node("/escapes", &["write", "/usr/made"]),
    ]);
    (spec.profile, spec.writable) = (Profile::Compile, Some(upper.clone()));
    spec.owned_directories = vec!["/usr/space".into(), "/new/deep".into()];
    let servant = world.start(spec).await;
    let code = async |name: &str| with_timeout(servant.wait_node(name)).await.unwrap().code;
    assert_eq!(code("/writes").await, Some(0));
    assert_eq!(code("/gives").await, Some(libc::EPERM));
    assert_eq!(code("/escapes").await, Some(libc::EACCES));
    let (first, _) = servant.uid_range();
    world.stop(servant).await;
    let owner = |path: &str| std::fs::metadata(upper.join(path)).unwrap().uid();
    assert_eq!(owner("usr/space/made"), first + 1000);
    assert_eq!((owner("new"), owner("new/deep")), (first, first + 1000));
}
