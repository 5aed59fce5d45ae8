//! Dependencies that a package of the same workspace meets under another name: `tf2_ros_py` has the Python module
//! `tf2_ros`, and a fork replaces the package that it was made from.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use foreign::Visit;
use rustix::fs::FileType;

use crate::manifest::Manifest;
use crate::workspace::Package;

/// Maximum number of modules of a package.
const MOST_MODULES: usize = 100;
/// Directories of a package that are no modules for others, whatever is in them.
const NO_MODULES: [&str; 8] = ["build", "config", "doc", "docs", "launch", "scripts", "test", "tests"];

/// Packages of a workspace by the other names under which they meet dependencies.
pub struct Providers<'a> {
    packages: &'a [Package],
    /// Name → indexes of the packages that replace the package of this name.
    replacing: BTreeMap<&'a str, Vec<usize>>,
    /// Name → indexes of the packages with a Python module of this name.
    modules: BTreeMap<&'a str, Vec<usize>>,
}

impl<'a> Providers<'a> {
    /// Indexes packages. A name that is a package's own is provided by that package alone.
    pub fn new(packages: &'a [Package]) -> Self {
        let own: BTreeSet<&str> = packages.iter().map(|package| package.manifest.name.as_str()).collect();
        let mut providers = Self { packages, replacing: BTreeMap::new(), modules: BTreeMap::new() };
        for (index, package) in packages.iter().enumerate() {
            for name in package.manifest.replaces.iter().filter(|name| !own.contains(name.as_str())) {
                providers.replacing.entry(name).or_default().push(index);
            }
            for name in package.modules.iter().filter(|name| !own.contains(name.as_str())) {
                providers.modules.entry(name).or_default().push(index);
            }
        }
        providers
    }

    /// Returns the indexes of the packages that meet a dependency of `package` which is no package of the workspace:
    /// those that replace it, or else, if only its Python module can be meant, those that have this module.
    pub fn find(&self, package: &Manifest, name: &str) -> &[usize] {
        if let Some(found) = self.replacing.get(name) {
            return found;
        }
        match self.modules.get(name) {
            Some(found) if package.needs_as_module(name) => found,
            _ => &[],
        }
    }

    /// Returns the indexes of all packages that meet a dependency of `package` under another name.
    pub fn find_all(&self, package: &Manifest) -> BTreeSet<usize> {
        let names = package.dependencies.iter().filter(|dependency| dependency.kind.is_needed());
        let found = names.flat_map(|dependency| self.find(package, &dependency.name));
        let others = found.copied().filter(|index| self.packages[*index].manifest.name != package.name);
        others.collect()
    }
}

/// Returns the names of the Python modules beside the `setup.py` of a package: directories with an `__init__.py`. None
/// if the directory cannot be read. Blocking.
pub(crate) fn find_modules(directory: &Path) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    // The package may be behind a link that stays inside, as in the search of the workspace.
    let Ok(directory) = directory.canonicalize() else {
        return found;
    };
    let walked = foreign::walk(&directory, |entry| {
        let parts: Vec<&str> = entry.path.iter().filter_map(|part| part.to_str()).collect();
        if let ([module, "__init__.py"], FileType::RegularFile) = (&parts[..], entry.kind())
            && found.len() < MOST_MODULES
        {
            found.insert((*module).to_owned());
        }
        let is_searched = match &parts[..] {
            [] => true,
            [name] => !name.starts_with('.') && !NO_MODULES.contains(name),
            _ => false,
        };
        Ok::<_, foreign::Error>(if is_searched { Visit::Into } else { Visit::Skip })
    });
    if walked.is_ok() { found } else { BTreeSet::new() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::condition::Variables;
    use crate::workspace::{self, PushedDirectory};

    /// Inspects a workspace for ROS 2 of packages, each with the rest of its package.xml and its files.
    fn inspect(packages: &[(&str, &str, &[&str])]) -> Vec<Package> {
        let root = tempfile::tempdir().expect("a directory");
        for (name, rest, files) in packages {
            let directory = root.path().join("src").join(name);
            std::fs::create_dir_all(&directory).expect("made");
            let text = format!("<package format=\"3\"><name>{name}</name><version>1.0.0</version>{rest}</package>");
            std::fs::write(directory.join("package.xml"), text).expect("written");
            for file in *files {
                let path = directory.join(file);
                std::fs::create_dir_all(path.parent().expect("below")).expect("made");
                std::fs::write(path, "").expect("written");
            }
        }
        match workspace::inspect(root.path(), &Variables::for_distribution(2, "jazzy")).expect("a workspace") {
            PushedDirectory::Source(workspace) => workspace.packages,
            PushedDirectory::Installed(space) => panic!("{space:?}"),
        }
    }

    const PYTHON: &str = "<export><build_type>ament_python</build_type></export>";
    const CMAKE: &str = "<export><build_type>ament_cmake</build_type></export>";

    fn missing(packages: &[Package]) -> Vec<(String, Vec<String>)> {
        let external = workspace::external_dependencies(packages).into_iter();
        external.map(|one| (one.name, one.needed_by.into_iter().collect())).collect()
    }

    #[test]
    fn a_module_of_another_package_is_enough_for_python() {
        let [python, cmake] = [PYTHON, CMAKE].map(|built| format!("<depend>tf2_ros</depend>{built}"));
        let files = ["setup.py", "tf2_ros/__init__.py", "test/__init__.py"];
        let tf2 = ("tf2_ros_py", PYTHON, &files[..]);
        let packages = inspect(&[tf2, ("app", &*python, &[][..])]);
        assert!(missing(&packages).is_empty(), "{packages:?}");
        assert_eq!(packages.iter().map(|one| one.modules.len()).sum::<usize>(), 1, "{packages:?}");
        let app = packages.iter().find(|one| one.manifest.name == "app").expect("there");
        let found = Providers::new(&packages).find_all(&app.manifest);
        let names: Vec<&str> = found.iter().map(|index| packages[*index].manifest.name.as_str()).collect();
        assert_eq!(names, ["tf2_ros_py"]);
        // Headers are not.
        let packages = inspect(&[tf2, ("app", &*cmake, &[][..]), ("py", &*python, &[][..])]);
        assert_eq!(missing(&packages), [("tf2_ros".to_owned(), vec!["app".to_owned()])]);
        let run = format!("<exec_depend>tf2_ros</exec_depend>{CMAKE}");
        assert!(missing(&inspect(&[tf2, ("app", &*run, &[][..])])).is_empty());
    }

    #[test]
    fn a_package_that_replaces_another_comes_before_those_that_need_it() {
        let (replaces, needs) = (format!("<replace>warp</replace>{CMAKE}"), format!("<depend>warp</depend>{CMAKE}"));
        let (fork, app) = (("zz_fork", &*replaces, &[][..]), ("app", &*needs, &[][..]));
        let packages = inspect(&[app, fork]);
        let names: Vec<&str> = packages.iter().map(|one| one.manifest.name.as_str()).collect();
        assert_eq!(names, ["zz_fork", "app"]);
        assert!(missing(&packages).is_empty(), "{packages:?}");
        // The package itself is meant where it is there too.
        let packages = inspect(&[app, fork, ("warp", CMAKE, &[][..])]);
        let app = packages.iter().find(|one| one.manifest.name == "app").expect("there");
        assert!(Providers::new(&packages).find_all(&app.manifest).is_empty());
    }
}
