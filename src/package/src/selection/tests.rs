use super::*;
use crate::condition::Variables;
use crate::workspace::{PushedDirectory, inspect};

/// A workspace with packages and the dependencies that they declare.
struct SelectionFixture(tempfile::TempDir);

impl SelectionFixture {
    fn new(packages: &[(&str, &str)]) -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        for (name, needs) in packages {
            let needs: String = needs.split_whitespace().map(|need| format!("<depend>{need}</depend>")).collect();
            let manifest = format!("<package format='3'><name>{name}</name>{needs}</package>");
            place.write(&format!("{name}/package.xml"), &manifest);
        }
        place
    }

    fn write(&self, path: &str, text: &str) -> &Self {
        let path = self.0.path().join("src").join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
        self
    }

    fn workspace(&self) -> Workspace {
        let variables = Variables::for_distribution(1, "noetic");
        let PushedDirectory::Source(workspace) = inspect(self.0.path(), &variables).expect("a workspace") else {
            panic!("sources")
        };
        workspace
    }

    fn select(&self, query: &PackageQuery<'_>) -> Result<Vec<String>, Error> {
        let mut workspace = self.workspace();
        let all = workspace.packages.len();
        let left_out = select_packages(&mut workspace, query, RosVersion::One)?;
        assert_eq!(workspace.packages.len() + workspace.left_out.len(), all);
        assert_eq!(workspace.left_out.len(), left_out.len());
        let mut names: Vec<String> = workspace.packages.into_iter().map(|package| package.manifest.name).collect();
        names.sort();
        Ok(names)
    }
}

fn texts(names: &[&str]) -> Vec<String> {
    names.iter().map(|&name| name.to_owned()).collect()
}

/// A stack as of a robot: a planner with plugins, a map server, a demo.
fn robot_stack() -> SelectionFixture {
    let place = SelectionFixture::new(&[
        ("costmap", "nav_core"),
        ("demos", "planner gazebo_ros"),
        ("map_server", ""),
        ("nav_core", ""),
        ("planner", "costmap"),
        ("spline", "nav_core"),
    ]);
    place
        .write("planner/CMakeLists.txt", "catkin_package()\nadd_executable(plan src/plan.cpp)\n")
        .write("planner/launch/all.launch", "<launch><node pkg='map_server' type='serve' name='m'/></launch>")
        .write("planner/CHANGELOG.rst", "* the demos and spline are new\n");
    place
}

#[test]
fn what_is_named_is_built_with_what_it_needs() {
    let place = robot_stack();
    for (up_to, skip, expected) in [
        (&["planner"][..], &[][..], &["costmap", "nav_core", "planner"][..]),
        (&["spline", "costmap"], &[], &["costmap", "nav_core", "spline"]),
        (&[], &["demos"], &["costmap", "map_server", "nav_core", "planner", "spline"]),
        (&["planner"], &["nav_core"], &["costmap", "planner"]),
        (&[], &[], &["costmap", "demos", "map_server", "nav_core", "planner", "spline"]),
    ] {
        let (up_to, skip) = (texts(up_to), texts(skip));
        let query = PackageQuery { up_to: &up_to, skip: &skip, ..PackageQuery::default() };
        assert_eq!(place.select(&query).expect("known"), expected, "{query:?}");
    }
}

#[test]
fn what_no_chosen_node_needs_is_not_built() {
    let place = robot_stack();
    let planner = &["costmap", "nav_core", "planner"][..];
    for (nodes, text, expected) in [
        (&["planner/plan"][..], "", planner),
        // Found by its build file.
        (&["plan --rate 1"], "", planner),
        (&["planner/plan", "topic_tools/relay /a /b"], "", planner),
        // A plugin.
        (&["planner/plan"], "spline/Planner", &["costmap", "nav_core", "planner", "spline"]),
        (&["map_server/serve"], "", &["map_server"]),
    ] {
        let nodes = texts(nodes);
        let query = PackageQuery { nodes: &nodes, texts: vec![text.to_owned()], ..PackageQuery::default() };
        let built = place.select(&query).expect("known");
        // The launch file of the planner mentions the map server.
        let built: Vec<&str> = built.iter().map(String::as_str).filter(|name| *name != "map_server").collect();
        let expected: Vec<&str> = expected.iter().copied().filter(|name| *name != "map_server").collect();
        assert_eq!(built, expected, "{query:?}");
    }
    let launch = PackageQuery { launch: Some("all.launch"), ..PackageQuery::default() };
    assert_eq!(place.select(&launch).expect("known"), ["costmap", "map_server", "nav_core", "planner"]);
    // A package that is used without being declared.
    place.write("map_server/src/serve.cpp", "#include <spline/spline.h>\n");
    let nodes = texts(&["map_server/serve"]);
    let query = PackageQuery { nodes: &nodes, ..PackageQuery::default() };
    assert_eq!(place.select(&query).expect("known"), ["map_server", "nav_core", "spline"]);
}

#[test]
fn where_it_is_unknown_what_runs_everything_is_built() {
    let place = robot_stack();
    for (nodes, launch) in
        [(&[][..], None), (&["unknown"], None), (&["topic_tools/relay"], None), (&[], Some("x.launch"))]
    {
        let nodes = texts(nodes);
        let query = PackageQuery { nodes: &nodes, launch, ..PackageQuery::default() };
        assert_eq!(place.select(&query).expect("known").len(), 6, "{query:?}");
    }
}

#[test]
fn options_that_name_nothing_are_refused() {
    let place = robot_stack();
    let names = texts(&["plannr"]);
    let refused = place.select(&PackageQuery { up_to: &names, ..PackageQuery::default() }).expect_err("misspelt");
    let text = refused.to_string();
    assert!(text.starts_with("--packages-up-to: no package \"plannr\"") && text.contains("costmap, demos"), "{text}");
    let all = texts(&["costmap", "demos", "map_server", "nav_core", "planner", "spline"]);
    let refused = place.select(&PackageQuery { skip: &all, ..PackageQuery::default() }).expect_err("nothing is left");
    assert!(refused.to_string().contains("--packages-skip"), "{refused}");
}
