//! Signals, closed streams, and errors, as commands end with them.

use std::fs;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::cli::command_line::{Folder, object, short, texts};
use crate::cli::files::{done, endless, folder, names, program, shell};

fn signal(child: &Child, name: &str) {
    let sent = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status();
    assert!(sent.unwrap().success());
}

/// Waits until `condition` holds.
fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while !condition() {
        assert!(Instant::now() < deadline, "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn interrupted_training_keeps_the_best_epoch() {
    let folder = Folder::new("told-to-end");
    let endless = endless(&folder);
    // Under nohup a hangup changes nothing.
    let hangup = if ignores_hangups() { "terminate" } else { "hangup" };
    for (name, reason) in [("TERM", "terminate"), ("INT", "interrupt"), ("HUP", hangup)] {
        let child = program(&folder, &format!("{endless} --out {name}.weights --format json"))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        // The temporary file exists once the work starts.
        wait_until("no training begins", || {
            names(&folder, ".").iter().any(|n| n.starts_with(".host"))
        });
        std::thread::sleep(Duration::from_millis(300));
        signal(&child, name);
        if name == "HUP" && reason == "terminate" {
            signal(&child, "TERM");
        }
        let output = child.wait_with_output().unwrap();
        let standard = done(&output);
        assert_eq!(object(&standard)["stopped"], reason, "{standard}");
        folder.succeed(&format!("weights verify {name}.weights"));
    }
    assert!(!names(&folder, ".").iter().any(|name| name.starts_with(".host")));
}

/// Whether this process, and so each that it starts, ignores SIGHUP, the first signal of the mask.
fn ignores_hangups() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask & 1 == 1)
}

#[test]
fn interrupted_run_keeps_previous_results() {
    let folder = Folder::new("run-told-to-end");
    folder.succeed("run paper --out out --without-learning --seed 3");
    let before = folder.files("out");
    let mut long = folder.succeed("scenario paper");
    assert!(long.contains("duration = 40.0"));
    long = long
        .replace("duration = 40.0", "duration = 400000.0")
        .replace("trace_stride = 1", "trace_stride = 0");
    folder.write("long.toml", &long.replace("to = 40.0", "to = 400000.0"));
    for (name, code) in [("TERM", 143), ("INT", 130)] {
        let mut child = program(&folder, "run long.toml --out out --without-learning")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let is_staged = || names(&folder, "out").iter().any(|name| name.starts_with(".host"));
        wait_until("no run begins", is_staged);
        signal(&child, name);
        assert_eq!(child.wait().unwrap().code(), Some(code), "{name}");
        assert!(folder.files("out") == before, "{name}");
    }
}

#[test]
fn closed_streams_do_not_lose_results() {
    let folder = folder("streams");
    // Few samples, which causes a warning.
    folder.succeed("run paper --out paper-run");
    let samples = fs::read_to_string(folder.path("paper-run/agent1_cycle1_samples.csv")).unwrap();
    let few: Vec<_> = samples.lines().take(402).collect();
    folder.write("few.csv", &(few.join("\n") + "\n"));
    let train = "$HS train few.csv --scenario paper --agent 1 --out";
    let (said, _) = shell(&folder, &format!("{train} warned.weights 2>&1 >/dev/null"));
    assert!(said.starts_with("warning: "), "{said}");
    for (line, code, made) in [
        (format!("{train} a.weights 2>/dev/full"), 0, "a.weights"),
        (format!("{train} b.weights 2>&-"), 0, "b.weights"),
        (format!("{train} c.weights >&- 2>&-"), 0, "c.weights"),
        (format!("{train} d.weights >/dev/full 2>&1"), 1, "d.weights"),
        (
            format!("{{ {train} e.weights; echo $? >e.code; }} | true; exit $(cat e.code)"),
            0,
            "e.weights",
        ),
        (
            format!(
                "{{ {train} f.weights 2>&1 >/dev/null; echo $? >f.code; }} | true; exit $(cat f.code)"
            ),
            0,
            "f.weights",
        ),
        ("$HS run mine.toml --out g >/dev/full 2>/dev/full".to_owned(), 1, "g/traces.csv"),
        ("$HS run none.toml --format json >/dev/full 2>/dev/full".to_owned(), 2, "few.csv"),
        ("$HS --nonsense 2>/dev/full".to_owned(), 2, "few.csv"),
        ("$HS --help >/dev/full 2>/dev/full".to_owned(), 1, "few.csv"),
        ("$HS scenario paper >/dev/full 2>/dev/full".to_owned(), 1, "few.csv"),
    ] {
        if !cfg!(target_os = "linux") && line.contains("/dev/full") {
            continue;
        }
        assert_eq!(shell(&folder, &line).1, Some(code), "{line}");
        assert!(folder.path(made).exists(), "{line}");
    }
    // Errors keep exit code 2 if the reader is gone.
    let line =
        "{ $HS weights verify few.csv --format json; echo $? >code; } | true; exit $(cat code)";
    assert_eq!(shell(&folder, line).1, Some(2));
}

#[test]
fn json_errors_have_code_text_file_and_line() {
    let folder = folder("json-errors");
    folder.write("wrong.toml", &short().text().replace("duration = 0.8", "duration = -0.8"));
    fs::create_dir(folder.path("other")).unwrap();
    folder.write("other/agents.csv", "mine\n");
    let line = short().text().lines().position(|line| line.starts_with("duration")).unwrap() + 1;
    for (arguments, exit, code, file, line) in [
        ("run wrong.toml", 2, "invalid-scenario", Some("wrong.toml"), Some(line)),
        ("run none.toml", 2, "invalid-scenario", Some("none.toml"), None),
        ("run mine.toml --out other", 2, "output-refused", Some("other/agents.csv"), None),
        ("run mine.toml --out node.weights", 1, "output-failed", Some("node.weights"), None),
        ("run mine.toml --nonsense", 2, "usage", None, None),
        ("run", 2, "usage", None, None),
        ("reproduce --recipe best", 2, "usage", None, None),
        (
            "train none.csv --scenario mine.toml --agent 1 --out x",
            2,
            "invalid-samples",
            Some("none.csv"),
            None,
        ),
        ("train none.csv --scenario mine.toml --agent 9 --out x", 2, "usage", None, None),
        ("weights inspect mine.toml", 2, "invalid-package", Some("mine.toml"), None),
        ("weights verify mine.toml", 2, "invalid-package", None, None),
        ("weights diff node.weights none", 2, "invalid-package", Some("none"), None),
        ("weights sign node.weights --key mine.toml", 2, "invalid-key", Some("mine.toml"), None),
        (
            "weights keygen --out node.weights/below",
            1,
            "output-failed",
            Some("node.weights/below.pub"),
            None,
        ),
        ("weights export node.weights --out x.txt", 2, "invalid-network", Some("x.txt"), None),
        (
            "weights import x.npz --base node.weights --out y",
            2,
            "invalid-network",
            Some("x.npz"),
            None,
        ),
        (
            "weights image node.weights --slot a --memory mine.toml",
            2,
            "invalid-memory-map",
            Some("mine.toml"),
            Some(1),
        ),
        ("monitor unix:none", 1, "node-unreachable", None, None),
        ("push unix:none none", 2, "invalid-package", Some("none"), None),
        ("node unix:none", 1, "node-unreachable", None, None),
        ("cosim none.toml", 2, "invalid-scenario", Some("none.toml"), None),
    ] {
        let output = folder.run(&format!("{arguments} --format json"));
        let (standard, said) = texts(&output);
        assert_eq!(output.status.code(), Some(exit), "{arguments}: {standard}{said}");
        let error = &object(&standard)["error"];
        assert_eq!(error["code"], code, "{arguments}: {error}");
        assert!(error["text"].as_str().is_some_and(|text| !text.is_empty()), "{arguments}");
        if file.is_some() || code == "usage" {
            assert_eq!(error["file"].as_str(), file, "{arguments}: {error}");
        }
        if line.is_some() {
            assert_eq!(
                error["line"].as_u64(),
                line.map(|line| line as u64),
                "{arguments}: {error}"
            );
        }
        assert!(said.starts_with("error: "), "{arguments}: {said}");
    }
}

#[test]
fn control_characters_from_files_are_escaped() {
    let folder = folder("escapes");
    // In TOML syntax.
    let name = r#""\u001b[2J\r\nok\u009b\u202e""#;
    let recipe = short().text().replace("\"short\"", name);
    let recipe = recipe.replace("recipes.short", &format!("recipes.{name}"));
    assert_eq!(recipe.matches(name).count(), 2);
    folder.write("evil.toml", &recipe);
    let evil = "no\u{1b}[2J\u{7f}\u{202e}.toml";
    for arguments in [
        vec!["run", "evil.toml"],
        vec!["weights", "inspect", "out/scenario_builder/agent1_cycle1.weights"],
        vec!["run", evil],
        vec!["run", evil, "--format", "json"],
        vec!["weights", "inspect", evil],
        vec!["weights", "keygen", "--out", evil],
        vec!["scenario", evil],
        vec!["train", evil, "--scenario", evil, "--agent", "1", "--out", evil],
        vec![evil],
    ] {
        let output = program(&folder, "").args(&arguments).output().unwrap();
        let (standard, error) = texts(&output);
        for c in (standard + &error).chars() {
            let plain = !c.is_control() && c != '\u{202e}';
            assert!(plain || c == '\n' || c == '\t', "{c:?} of {arguments:?}");
        }
    }
}
