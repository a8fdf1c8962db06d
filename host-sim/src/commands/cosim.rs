//! `cosim`: a scenario together with nodes that are really there.

use std::fmt::Write;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use clap::Args;

use super::warnings;
use super::{CommandError, Common, Format, SharedProgress, load_scenario, print_json, print_text};
use crate::analysis::StepCheck;
use crate::cosim::endpoint::{Endpoint, for_agents};
use crate::cosim::fault::{Fault, NodeError};
use crate::cosim::qemu::{Channel, MACHINE, PROGRAM, Qemu};
use crate::cosim::{CosimReport, Service, Setup, board::Board, cosimulate};
use crate::interruption::{self, Again};
use crate::memory_map::MemoryMap;
use crate::packages::PackageBytes;
use crate::progress::ProgressBars;
use crate::scenario::Scenario;
use crate::shell::shell_word;
use crate::warning::{Warning, WarningCode};

/// Arguments of `cosim`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// The scenario, a TOML file or the name of a built-in one
    #[arg(default_value = "paper")]
    scenario: PathBuf,
    /// What the nodes run on, one for all or one for each agent: qemu (pipes, the fastest),
    /// qemu-uart (its serial line), serial:/dev/tty...[@BAUD] (a real board), unix:PATH
    #[arg(long, value_delimiter = ',', default_value = "qemu")]
    boards: Vec<Endpoint>,
    /// How many steps to take [default: all of the scenario; with --serve, no end]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    steps: Option<u64>,
    /// Recipe of the scenario for all its learning cycles [default: what each cycle names]
    #[arg(long)]
    recipe: Option<String>,
    /// Leaves the scenario's learning cycles out
    #[arg(long)]
    without_learning: bool,
    /// What emulated nodes run [default: what `cargo xtask firmware --board qemu-mps2-an386` builds]
    #[arg(long, value_name = "ELF")]
    firmware: Option<PathBuf>,
    /// The memory map that it was linked with [default: the project's memory.x]
    #[arg(long, value_name = "MEMORY.X")]
    memory: Option<PathBuf>,
    /// The emulator
    #[arg(long, default_value = PROGRAM)]
    qemu: PathBuf,
    /// How long a node may take for an answer [s]
    #[arg(long, default_value_t = 10.0, value_parser = above_zero)]
    timeout: f64,
    /// Goes on in real time and offers every node at FOLDER/agent-N.sock, to `monitor`, `push` and
    /// `node`
    #[arg(long, value_name = "FOLDER")]
    serve: Option<PathBuf>,
    /// With --serve: how much faster than real time
    #[arg(long, default_value_t = 1.0, requires = "serve", value_parser = above_zero)]
    speed: f64,
    #[command(flatten)]
    pub(super) common: Common,
}

/// A number above 0, and one that counts seconds.
pub(super) fn above_zero(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| *number > 0.0 && *number < 1e9);
    number.ok_or_else(|| "write a number above 0".to_owned())
}

/// Steps of a run that is to have no end: so many days that nobody sees it.
const ENDLESS: u64 = 1 << 40;

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    interruption::listen(Again::Wait);
    let scenario = scenario(arguments)?;
    let endpoints =
        for_agents(&arguments.boards, scenario.agents.len()).map_err(CommandError::Usage)?;
    let step = StepCheck::new(&scenario);
    if !step.is_stable() {
        warnings::print(&[Warning::new(WarningCode::UnstableStep, step.describe())]);
    }
    // What can be refused is refused before anything is built.
    crate::cosim::prepared(&scenario)?;
    let timeout = Duration::from_secs_f64(arguments.timeout);
    let emulated = endpoints.iter().any(|endpoint| !matches!(endpoint, Endpoint::At(_)));
    let qemu = emulated.then(|| emulator(arguments, timeout)).transpose()?;
    let start = &mut |index: usize, package: &PackageBytes| {
        let board = match (&endpoints[index], &qemu) {
            (Endpoint::Qemu, Some(qemu)) => qemu.start(Channel::Pipes, package),
            (Endpoint::QemuUart, Some(qemu)) => qemu.start(Channel::Uart, package),
            (Endpoint::At(address), _) => address
                .connect()
                .map(|line| Board::new(line, &address.to_string(), true))
                .map_err(|error| Fault::Start(error.to_string())),
            (_, None) => Err(Fault::Start("there is no emulator".to_owned())),
        };
        let board_name = || endpoints[index].to_string();
        board.map_err(|fault| NodeError { agent: index + 1, board: board_name(), fault })
    };
    let service = arguments.serve.as_ref().map(|folder| Service {
        folder: folder.clone(),
        speed: arguments.speed,
        stop: Arc::default(),
    });
    if arguments.serve.is_some() && arguments.common.format == Format::Text {
        eprintln!("{}", served(arguments, endpoints.len()));
    }
    let bars = ProgressBars::new("co-simulating");
    let done = AtomicU64::new(0);
    let progress = SharedProgress::new(&bars, &done, scenario.steps());
    let setup = Setup::new(start, timeout);
    let report = cosimulate(&scenario, arguments.common.seed, setup, service.as_ref(), &progress)?;
    bars.finish();
    match arguments.common.format {
        Format::Json => print_json(&report)?,
        Format::Text => print_text(&text(&scenario, arguments, &report))?,
    }
    match &report.first_mismatch {
        None => Ok(()),
        Some(first) => Err(CommandError::Mismatches(format!(
            "{} steps of nodes differ from the simulated ones, first {first}",
            report.mismatches
        ))),
    }
}

/// How to talk to the nodes.
fn served(arguments: &Arguments, agents: usize) -> String {
    let Some(folder) = &arguments.serve else { return String::new() };
    let socket = shell_word(&folder.join("agent-1.sock"));
    let others = if agents > 1 { format!(", agents 1 to {agents}") } else { String::new() };
    format!(
        "Nodes can be reached until Ctrl-C{others}:\n  host-sim monitor {socket}\n  host-sim push \
         {socket} PACKAGE\n  host-sim node {socket} status"
    )
}

fn scenario(arguments: &Arguments) -> Result<Scenario, CommandError> {
    let mut scenario = load_scenario(&arguments.scenario)?;
    if let Some(recipe) = &arguments.recipe {
        if scenario.recipe(recipe).is_none() {
            let names: Vec<_> = scenario.recipes.iter().map(|r| r.name.as_str()).collect();
            return Err(CommandError::Usage(format!(
                "--recipe {recipe}: scenario {} has the recipes {}",
                scenario.name,
                names.join(", ")
            )));
        }
        scenario.learning.iter_mut().for_each(|cycle| cycle.recipe.clone_from(recipe));
    }
    if arguments.without_learning {
        scenario.learning.clear();
    }
    let endless = arguments.serve.is_some().then_some(ENDLESS);
    if let Some(steps) = arguments.steps.or(endless) {
        scenario.time.duration = steps as f64 * scenario.time.step_size;
    }
    Ok(scenario)
}

fn emulator(arguments: &Arguments, timeout: Duration) -> Result<Qemu, CommandError> {
    let memory = match &arguments.memory {
        Some(memory) => memory.clone(),
        None => workspace("--memory MEMORY.X")?.join("memory.x"),
    };
    let region = MemoryMap::read(&memory)?.weights()?;
    let firmware = match &arguments.firmware {
        Some(firmware) if !firmware.is_file() => {
            let problem = format!("{}: there is no such file", firmware.display());
            return Err(CommandError::Usage(format!(
                "{problem}; name the firmware's ELF file, or leave --firmware out to have it built"
            )));
        }
        Some(firmware) => firmware.clone(),
        None => build_firmware(&workspace("--firmware ELF")?)?,
    };
    Ok(Qemu { program: arguments.qemu.clone(), firmware, region, timeout })
}

/// The folder of the project: around the current one, or where this program was built.
fn workspace(otherwise: &str) -> Result<PathBuf, CommandError> {
    let is_project = |folder: &&Path| folder.join("firmware-template/Cargo.toml").is_file();
    let current = std::env::current_dir()?;
    let built = Path::new(env!("CARGO_MANIFEST_DIR"));
    let found = current.ancestors().chain(built.ancestors()).find(is_project);
    found.map(Path::to_owned).ok_or_else(|| {
        CommandError::Usage(format!(
            "this is no folder of the project, whose firmware and memory.x are needed; change into \
             it, or give {otherwise}"
        ))
    })
}

/// Builds the firmware of emulated nodes; what the build says goes to standard error.
fn build_firmware(workspace: &Path) -> Result<PathBuf, CommandError> {
    let line = format!("cargo xtask firmware --board qemu-{MACHINE}");
    let failed = |what: String| {
        CommandError::Firmware(format!("`{line}` {what}; mend that, or give --firmware ELF"))
    };
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut build = Command::new(cargo)
        .args(line.split(' ').skip(1))
        .current_dir(workspace)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .map_err(|error| failed(format!("cannot be started: {error}")))?;
    let mut firmware = None;
    if let Some(output) = build.stdout.take() {
        for line in BufReader::new(output).lines() {
            let line = line?;
            match line.strip_prefix("firmware: ") {
                Some(path) => firmware = Some(workspace.join(path)),
                None => eprintln!("{line}"),
            }
        }
    }
    let status = build.wait()?;
    if !status.success() {
        return Err(failed(format!("fails ({status})")));
    }
    firmware.ok_or_else(|| failed("does not say where the firmware is".to_owned()))
}

fn text(scenario: &Scenario, arguments: &Arguments, report: &CosimReport) -> String {
    let mut text =
        String::from("\nagent  board                   steps  mismatches  broadcasts  switches\n");
    for board in &report.boards {
        // Writing into a string cannot fail.
        let _ = writeln!(
            text,
            "{:5}  {:20}  {:7}  {:10}  {:10}  {:8}",
            board.agent,
            board.board,
            board.compared,
            board.mismatches,
            board.broadcasts,
            board.switches
        );
    }
    for board in &report.boards {
        if let Some(parted) = &board.parted {
            let _ = writeln!(text, "Agent {} is not compared {parted}", board.agent);
        }
    }
    let _ = writeln!(
        text,
        "\nEstimate, outer weights, derivative, outcome, trigger and frame compared in every step, bit for \
         bit: {}\n\
         {} steps in {:.2} s, {:.0} a second ({:.0} round trips)\n\
         Scenario {}, seed {}, digest {}",
        match report.mismatches {
            0 => "all equal".to_owned(),
            count => format!("{count} steps differ"),
        },
        report.steps,
        report.elapsed_s,
        report.steps_per_s,
        report.steps_per_s * report.nodes as f64,
        scenario.name,
        arguments.common.seed,
        report.digest,
    );
    text
}
