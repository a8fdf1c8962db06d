//! The manifests of a project, from the template's.

use toml_edit::{Array, DocumentMut, Item, Table, TableLike, value};

use crate::{
    firmware::{BOARDS, Board},
    step::Failure,
};

/// The node's, with one board of all.
pub(super) fn node(text: &str, board: &Board) -> Result<DocumentMut, Failure> {
    let mut manifest = parse(text)?;
    manifest["package"]["name"] = value("node");
    manifest["package"]["description"] = value(format!("A node on the board {}", board.name));
    // The program calls the library by the name that it has in the template.
    let mut library = Table::new();
    library["name"] = value("firmware_template");
    manifest["lib"] = Item::Table(library);

    let programs = manifest["bin"].as_array_of_tables_mut().ok_or_else(|| unexpected("[[bin]]"))?;
    programs.retain(|program| program.get("name").and_then(Item::as_str) == Some(board.name));
    let program = programs.iter_mut().next().ok_or_else(|| unexpected("the board's [[bin]]"))?;
    program["name"] = value("node");
    program["path"] = value("src/main.rs");

    let features = table(&mut manifest, "features")?;
    for other in BOARDS.iter().filter(|other| other.name != board.name) {
        features.remove(other.name);
    }
    features.insert("default", value(Array::from_iter([board.name])));
    // What stays optional and is not turned on by any feature is another board's.
    let wanted = features.iter().map(|(_, entries)| entries.to_string()).collect::<String>();
    let of_boards = manifest["target"]["cfg(target_os = \"none\")"]["dependencies"]
        .as_table_like_mut()
        .ok_or_else(|| unexpected("the boards' dependencies"))?;
    for name in names(of_boards) {
        if !wanted.contains(&format!("\"dep:{name}\"")) {
            of_boards.remove(&name);
        }
    }
    Ok(manifest)
}

/// The agent's, as a dependency whose tests stay where it comes from.
pub(super) fn core(text: &str) -> Result<DocumentMut, Failure> {
    let mut manifest = parse(text)?;
    for part in ["dev-dependencies", "bench"] {
        manifest.remove(part);
    }
    let mut library = Table::new();
    library["test"] = value(false);
    library["doctest"] = value(false);
    manifest["lib"] = Item::Table(library);
    Ok(manifest)
}

/// The workspace's, with what the manifests `members` use.
pub(super) fn workspace(text: &str, members: [&DocumentMut; 2]) -> Result<DocumentMut, Failure> {
    let mut manifest = parse(text)?;
    manifest["workspace"]["members"] = value(Array::from_iter(["agent-core", "node"]));
    manifest["workspace"]["default-members"] = value(Array::from_iter(["node"]));

    let mut used = Vec::new();
    for member in members {
        collect_dependencies(member.as_table(), &mut used);
    }
    let dependencies = manifest["workspace"]["dependencies"]
        .as_table_like_mut()
        .ok_or_else(|| unexpected("[workspace.dependencies]"))?;
    for name in names(dependencies) {
        if !used.contains(&name) {
            dependencies.remove(&name);
        }
    }

    // Firmware is all that there is to release.
    let profiles = table(&mut manifest, "profile")?;
    let firmware = profiles.remove("firmware").ok_or_else(|| unexpected("[profile.firmware]"))?;
    let release = profiles
        .get_mut("release")
        .and_then(Item::as_table_like_mut)
        .ok_or_else(|| unexpected("[profile.release]"))?;
    for (name, setting) in firmware.as_table_like().into_iter().flat_map(TableLike::iter) {
        if name != "inherits" {
            release.insert(name, setting.clone());
        }
    }
    Ok(manifest)
}

/// The names in all tables of dependencies, wherever they stand.
fn collect_dependencies(table: &dyn TableLike, found: &mut Vec<String>) {
    for (name, item) in table.iter() {
        let Some(inner) = item.as_table_like() else { continue };
        if name.ends_with("dependencies") {
            found.extend(names(inner));
        } else {
            collect_dependencies(inner, found);
        }
    }
}

fn names(table: &dyn TableLike) -> Vec<String> {
    table.iter().map(|(name, _)| name.to_owned()).collect()
}

fn parse(text: &str) -> Result<DocumentMut, Failure> {
    text.parse()
        .map_err(|error| Failure::new(format!("a manifest: {error}"), "see cargo's message"))
}

fn table<'a>(manifest: &'a mut DocumentMut, name: &str) -> Result<&'a mut dyn TableLike, Failure> {
    manifest[name].as_table_like_mut().ok_or_else(|| unexpected(name))
}

fn unexpected(what: &str) -> Failure {
    Failure::new(
        format!("a manifest without {what}"),
        "teach xtask/src/project/manifest.rs how the manifests look now",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_project_has_one_board_and_what_it_needs() {
        let text = include_str!("../../../firmware-template/Cargo.toml");
        let core = core(include_str!("../../../agent-core/Cargo.toml")).unwrap();
        for board in &BOARDS {
            let node = node(text, board).unwrap();
            let workspace = workspace(include_str!("../../../Cargo.toml"), [&node, &core]).unwrap();
            let dependencies =
                node["target"]["cfg(target_os = \"none\")"]["dependencies"].to_string();
            assert_eq!(dependencies.contains("stm32f4xx-hal"), board.name == "stm32f405");
            assert_eq!(dependencies.contains("nrf52840-hal"), board.name == "nrf52840");
            assert!(dependencies.contains("cortex-m-rt"));
            let features = node["features"].to_string();
            for other in &BOARDS {
                assert_eq!(features.contains(other.name), other.name == board.name);
            }
            assert_eq!(node["bin"].as_array_of_tables().unwrap().len(), 1);
            let shared = workspace["workspace"]["dependencies"].as_table_like().unwrap();
            assert!(shared.contains_key("nalgebra") && !shared.contains_key("resvg"));
            assert_eq!(workspace["profile"]["release"]["lto"].as_str(), Some("fat"));
        }
    }
}
