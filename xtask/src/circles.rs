//! Checks that the modules of each crate do not depend on each other in cycles.
//!
//! In every folder, its files and folders are the nodes of a graph, and a node that names an item
//! of another depends on it. A name that a `mod.rs` or `lib.rs` re-exports counts as its origin.
//! The `mod.rs` itself is not a node of its own folder's graph, because it is the interface to the
//! modules behind it. Code compiled only for tests is ignored.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use proc_macro2::{Delimiter, TokenStream, TokenTree};

use crate::step::Failure;

/// The crates to check.
const SOURCES: [&str; 7] = [
    "agent-core/src",
    "agent-core/inner-network/src",
    "agent-core/integrity/src",
    "host-sim/src",
    "firmware-template/src",
    "python/src",
    "xtask/src",
];

/// A module's path from the crate root, which is empty for the root itself.
type Module = Vec<String>;

/// Checks every crate.
///
/// # Errors
/// A source cannot be read, or there is a cycle.
pub(crate) fn check(root: &Path) -> Result<(), Failure> {
    let mut told = String::new();
    for source in SOURCES {
        let modules = Modules::read(&root.join(source)).map_err(|problem| {
            Failure::new(format!("modules of {source}: {problem}"), "fix that file")
        })?;
        for circle in modules.circles() {
            let _ = writeln!(told, "{source}: {circle}");
        }
    }
    if told.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        format!("modules that depend on each other in a cycle:\n{}", told.trim_end()),
        "move the shared code into a separate module",
    ))
}

/// The modules of a crate, one per file.
#[derive(Default)]
struct Modules {
    /// The paths that each module names, from the crate root.
    named: BTreeMap<Module, BTreeSet<Vec<String>>>,
    /// The re-exports of each module under a name: a path from the crate root.
    exports: BTreeMap<(Module, String), Vec<String>>,
}

impl Modules {
    /// Reads the files below a folder with a `lib.rs` or `main.rs`.
    fn read(source: &Path) -> Result<Self, String> {
        let mut modules = Self::default();
        let mut rest = vec![(source.to_owned(), Vec::new())];
        let mut tests = BTreeSet::new();
        let mut texts = BTreeMap::new();
        while let Some((folder, module)) = rest.pop() {
            let entries =
                fs::read_dir(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
            for entry in entries {
                let path = entry.map_err(|error| error.to_string())?.path();
                let Some(stem) = path.file_stem().and_then(|stem| stem.to_str()) else { continue };
                let own = || [&module[..], &[stem.to_owned()]].concat();
                if path.is_dir() {
                    // Binaries are separate crates.
                    if stem != "bin" {
                        rest.push((path.clone(), own()));
                    }
                } else if path.extension().is_some_and(|ending| ending == "rs") {
                    let name = match stem {
                        "mod" | "lib" | "main" => module.clone(),
                        _ => own(),
                    };
                    let text = fs::read_to_string(&path).map_err(|error| error.to_string())?;
                    let tokens: TokenStream =
                        text.parse().map_err(|error| format!("{}: {error}", path.display()))?;
                    texts.entry(name).or_insert_with(Vec::new).push(tokens);
                }
            }
        }
        for (module, tokens) in &texts {
            for tokens in tokens {
                tests.extend(Scan::new(module).file(tokens.clone(), &mut modules));
            }
        }
        let of_tests = |module: &Module| tests.iter().any(|test: &Module| module.starts_with(test));
        modules.named.retain(|module, _| !of_tests(module));
        Ok(modules)
    }

    /// Returns the module that contains the item at `path`.
    fn home(&self, path: &[String]) -> Module {
        let mut path = path.to_vec();
        // A re-export can refer to another one; a long chain would be a cycle itself.
        for _ in 0..8 {
            let depth = (0..=path.len())
                .rev()
                .find(|&depth| self.named.contains_key(&path[..depth]))
                .unwrap_or(0);
            let module = path[..depth].to_vec();
            let Some(name) = path.get(depth) else { return module };
            match self.exports.get(&(module.clone(), name.clone())) {
                Some(origin) => path = [&origin[..], &path[depth + 1..]].concat(),
                None => return module,
            }
        }
        path
    }

    /// Describes the cycles, one per set of modules that depend on each other.
    fn circles(&self) -> Vec<String> {
        // For each folder: which of its children depends on which, and a pair of modules as an
        // example.
        let mut graphs: BTreeMap<Module, BTreeMap<String, BTreeMap<String, String>>> =
            BTreeMap::new();
        for (module, paths) in &self.named {
            for path in paths {
                let home = self.home(path);
                let depth = module.iter().zip(&home).take_while(|(a, b)| a == b).count();
                if let (Some(from), Some(to)) = (module.get(depth), home.get(depth)) {
                    let folder = graphs.entry(module[..depth].to_vec()).or_default();
                    let edges = folder.entry(from.clone()).or_default();
                    let shown = format!("{} names {}", module.join("::"), path.join("::"));
                    edges.entry(to.clone()).or_insert(shown);
                }
            }
        }
        graphs.values().flat_map(circles_in).collect()
    }
}

fn circles_in(graph: &BTreeMap<String, BTreeMap<String, String>>) -> Vec<String> {
    let mut circles = Vec::new();
    let mut done = BTreeSet::new();
    for start in graph.keys() {
        if done.contains(start) {
            continue;
        }
        // The shortest path from a module back to itself.
        let mut before: BTreeMap<&str, &str> = BTreeMap::new();
        let mut queue = vec![start.as_str()];
        let mut next = 0;
        while let Some(&at) = queue.get(next) {
            next += 1;
            for to in graph.get(at).into_iter().flat_map(BTreeMap::keys) {
                if !before.contains_key(to.as_str()) {
                    before.insert(to, at);
                    queue.push(to);
                }
            }
        }
        if !before.contains_key(start.as_str()) {
            continue;
        }
        let mut way = vec![start.as_str()];
        while let Some(&from) = before.get(way[way.len() - 1]) {
            way.push(from);
            if from == start {
                break;
            }
        }
        way.reverse();
        done.extend(way.iter().map(|&name| name.to_owned()));
        let edges = way.windows(2).map(|pair| graph[pair[0]][pair[1]].clone());
        circles.push(format!("{} ({})", way.join(" -> "), edges.collect::<Vec<_>>().join("; ")));
    }
    circles
}

/// The names used by one file.
struct Scan<'m> {
    module: &'m Module,
    /// Number of enclosing inline modules.
    inner: usize,
    tests: Vec<Module>,
}

impl<'m> Scan<'m> {
    fn new(module: &'m Module) -> Self {
        Self { module, inner: 0, tests: Vec::new() }
    }

    /// Records what a file names and re-exports. Returns the modules it declares only for tests.
    fn file(mut self, tokens: TokenStream, modules: &mut Modules) -> Vec<Module> {
        modules.named.entry(self.module.clone()).or_default();
        self.tokens(tokens, modules);
        self.tests
    }

    fn tokens(&mut self, tokens: TokenStream, modules: &mut Modules) {
        let tokens: Vec<TokenTree> = tokens.into_iter().collect();
        let mut at = 0;
        while at < tokens.len() {
            if let Some(end) = self.test_item(&tokens[at..]) {
                at += end;
                continue;
            }
            match &tokens[at] {
                TokenTree::Group(group) => self.tokens(group.stream(), modules),
                TokenTree::Ident(word) if word == "mod" && is_brace(tokens.get(at + 2)) => {
                    // In an inline module, `super` is this file.
                    if let Some(TokenTree::Group(body)) = tokens.get(at + 2) {
                        self.inner += 1;
                        self.tokens(body.stream(), modules);
                        self.inner -= 1;
                        at += 2;
                    }
                }
                TokenTree::Ident(word) if word == "use" => {
                    let exported = at > 0 && is_public(&tokens[at - 1]);
                    let end = tokens[at..].iter().position(is_semicolon);
                    let end = end.map_or(tokens.len(), |end| at + end);
                    for path in use_tree(&tokens[at + 1..end]) {
                        self.note_use(path, exported, modules);
                    }
                    at = end;
                }
                TokenTree::Ident(word)
                    if is_anchor(&word.to_string()) && !is_path(&tokens[..at]) =>
                {
                    let end = tokens[at..].iter().position(|token| !is_path_token(token));
                    let end = end.map_or(tokens.len(), |end| at + end);
                    for path in use_tree(&tokens[at..end]) {
                        self.note_use(path, false, modules);
                    }
                    at = end.max(at + 1) - 1;
                }
                _ => {}
            }
            at += 1;
        }
    }

    /// Returns the length of the test-only item at the start of these tokens.
    fn test_item(&mut self, tokens: &[TokenTree]) -> Option<usize> {
        let [TokenTree::Punct(hash), TokenTree::Group(attribute), rest @ ..] = tokens else {
            return None;
        };
        let text = attribute.stream().to_string().replace(' ', "");
        if hash.as_char() != '#' || !(text == "cfg(test)" || text.starts_with("cfg(all(test")) {
            return None;
        }
        if let [TokenTree::Ident(word), TokenTree::Ident(name), TokenTree::Punct(_), ..] = rest
            && word == "mod"
        {
            self.tests.push([&self.module[..], &[name.to_string()]].concat());
        }
        let end = rest.iter().position(|token| is_semicolon(token) || is_brace(Some(token)));
        end.map(|end| 2 + end + 1)
    }

    fn note_use(&self, path: Vec<String>, exported: bool, modules: &mut Modules) {
        let Some(path) = self.absolute(path) else { return };
        if exported && self.inner == 0 {
            if let Some(name) = path.last() {
                modules.exports.insert((self.module.clone(), name.clone()), path.clone());
            }
            // A module that only re-exports another does not depend on it.
            return;
        }
        modules.named.entry(self.module.clone()).or_default().insert(path);
    }

    /// Returns a path from the crate root; `None` for one into another crate. A path without
    /// `crate`, `super` or `self` can start with a child module, so it is tried as one.
    fn absolute(&self, path: Vec<String>) -> Option<Vec<String>> {
        let mut names = path.into_iter().peekable();
        let mut base = match names.peek().map(String::as_str)? {
            "crate" => {
                names.next();
                return Some(names.collect());
            }
            "self" => {
                names.next();
                self.module.clone()
            }
            _ => self.module.clone(),
        };
        let mut outer = self.inner;
        while names.next_if_eq("super").is_some() {
            if outer > 0 {
                outer -= 1;
            } else {
                base.pop();
            }
        }
        base.extend(names);
        Some(base)
    }
}

/// Returns every path after `use`, or in a path expression.
fn use_tree(tokens: &[TokenTree]) -> Vec<Vec<String>> {
    let mut paths = Vec::new();
    let (mut prefix, mut renamed) = (Vec::new(), false);
    for token in tokens {
        match token {
            TokenTree::Ident(word) if word == "as" => renamed = true,
            TokenTree::Ident(_) if renamed => {}
            TokenTree::Ident(word) => prefix.push(word.to_string()),
            TokenTree::Group(group) if group.delimiter() == Delimiter::Brace => {
                let inside: Vec<TokenTree> = group.stream().into_iter().collect();
                for part in inside.split(|token| is_punct(token, ',')) {
                    for mut path in use_tree(part) {
                        // `{self, ..}` is the module itself.
                        path.retain(|name| name != "self" || prefix.is_empty());
                        paths.push([&prefix[..], &path[..]].concat());
                    }
                }
                return paths;
            }
            _ => {}
        }
    }
    if !prefix.is_empty() {
        paths.push(prefix);
    }
    paths
}

fn is_anchor(word: &str) -> bool {
    matches!(word, "crate" | "super" | "self")
}

/// Whether the preceding tokens continue with a path.
fn is_path(before: &[TokenTree]) -> bool {
    before.last().is_some_and(|token| is_punct(token, ':') || is_punct(token, '.'))
        && before.len() >= 2
        && before.iter().rev().nth(1).is_some_and(|token| is_punct(token, ':'))
}

fn is_path_token(token: &TokenTree) -> bool {
    matches!(token, TokenTree::Ident(_)) || is_punct(token, ':')
}

fn is_punct(token: &TokenTree, sign: char) -> bool {
    matches!(token, TokenTree::Punct(punct) if punct.as_char() == sign)
}

fn is_semicolon(token: &TokenTree) -> bool {
    is_punct(token, ';')
}

fn is_brace(token: Option<&TokenTree>) -> bool {
    matches!(token, Some(TokenTree::Group(group)) if group.delimiter() == Delimiter::Brace)
}

/// Whether this token ends a visibility: `pub`, or the parentheses of `pub(crate)`.
fn is_public(token: &TokenTree) -> bool {
    match token {
        TokenTree::Ident(word) => word == "pub",
        TokenTree::Group(group) => group.delimiter() == Delimiter::Parenthesis,
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn circles(files: &[(&str, &str)]) -> Vec<String> {
        let mut modules = Modules::default();
        let mut tests = Vec::new();
        let files: Vec<(Module, &str)> = files
            .iter()
            .map(|(name, text)| {
                (name.split("::").filter(|n| !n.is_empty()).map(str::to_owned).collect(), *text)
            })
            .collect();
        for (module, text) in &files {
            tests.extend(Scan::new(module).file(text.parse().unwrap(), &mut modules));
        }
        modules.named.retain(|module, _| !tests.contains(module));
        modules.circles()
    }

    #[test]
    fn there_are_no_cycles() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
        if let Err(failure) = check(root) {
            panic!("{}", failure.what);
        }
    }

    #[test]
    fn cycles_are_found_in_every_spelling() {
        for there in [
            "use crate::b::B;",
            "use crate::{b::B, c};",
            "use super::b;",
            "fn f() { crate::b::g(); }",
            "mod inner { use super::super::b::B; }",
            "#[error(\"{}\", crate::b::text())] struct E;",
        ] {
            let found = circles(&[("", ""), ("a", there), ("b", "use crate::a;")]);
            assert_eq!(found.len(), 1, "{there}: {found:?}");
            assert!(found[0].starts_with("a -> b -> a (a names b"), "{found:?}");
        }
    }

    #[test]
    fn a_longer_cycle_is_found() {
        let files = [
            ("", "pub use c::C;"),
            ("a", "use crate::b::B;"),
            ("b::x", "use crate::C;"),
            ("b", ""),
            ("c", "use crate::a::A; use crate::d;"),
            ("d", ""),
        ];
        assert_eq!(
            circles(&files),
            ["a -> b -> c -> a (a names b::B; b::x names C; c names a::A)"]
        );
    }

    #[test]
    fn acyclic_modules_are_accepted() {
        let b = ("b", "use crate::a;");
        for there in [
            "",
            "#[cfg(test)] mod tests { use crate::b::B; }",
            "#[cfg(test)] use crate::b::B; fn f() {}",
            "// crate::b\n const TEXT: &str = \"crate::b\";",
            "use other::b::B;",
        ] {
            assert_eq!(circles(&[("", ""), ("a", there), b]), [""; 0], "{there}");
        }
        // The interface uses a module behind it, which uses the interface.
        let front = [("", ""), ("a", "mod x; use x::X; struct Y;"), ("a::x", "use super::Y;")];
        assert_eq!(circles(&front), [""; 0]);
        // Files compiled only for tests.
        let tests = [("", ""), ("a", "#[cfg(test)] mod t;"), ("a::t", "use crate::b;"), b];
        assert_eq!(circles(&tests), [""; 0]);
    }
}
