//! `cosim`: a scenario together with nodes that are really there.

mod emulated;

use std::fmt::Write;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use clap::Args;
use emulated::{FlashFolder, Signing};

use super::key::Passphrase;
use super::warnings;
use super::{
    CommandError, Common, ErrorCode, Format, SharedProgress, load_scenario, print_outcome,
    print_text,
};
use crate::analysis::StepCheck;
use crate::commands::progress::ProgressBars;
use crate::cosim::endpoint::{Endpoint, for_agents};
use crate::cosim::fault::{Fault, NodeError};
use crate::cosim::firmware::{self, Firmware};
use crate::cosim::qemu::{Channel, PROGRAM, Qemu};
use crate::cosim::{CosimReport, Notice, Service, Setup, board::Board, cosimulate};
use crate::interruption::{self, Again};
use crate::memory_map::MemoryMap;
use crate::packages::PackageBytes;
use crate::scenario::Scenario;
use crate::shell::shell_word;
use crate::terminal;
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
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=ENDLESS))]
    steps: Option<u64>,
    /// Recipe of the scenario for all its learning cycles [default: what each cycle names]
    #[arg(long)]
    recipe: Option<String>,
    /// Leaves the scenario's learning cycles out
    #[arg(long)]
    without_learning: bool,
    /// What emulated nodes run [default: what `cargo xtask firmware --board qemu-mps2-an386` builds in
    /// the project that the current folder lies in, else what `cargo xtask install` has installed]
    #[arg(long, value_name = "ELF")]
    firmware: Option<PathBuf>,
    /// The memory map that it was linked with [default: memory.x of the project or the installation]
    #[arg(long, value_name = "MEMORY.X")]
    memory: Option<PathBuf>,
    /// The emulator
    #[arg(long, default_value = PROGRAM)]
    qemu: PathBuf,
    /// How long a node may take for an answer [s]
    #[arg(long, default_value_t = 10.0, value_parser = timeout)]
    timeout: f64,
    /// Goes on in real time and offers every node at FOLDER/agent-N.sock, to `monitor`, `push` and
    /// `node`
    #[arg(long, value_name = "FOLDER")]
    serve: Option<PathBuf>,
    /// With --serve: how much faster than real time
    #[arg(long, default_value_t = 1.0, requires = "serve", value_parser = speed)]
    speed: f64,
    /// Keeps the flash of emulated nodes in this folder: the next run goes on with what it holds
    /// [default: erased, with the scenario's packages]
    #[arg(long, value_name = "FOLDER")]
    keep: Option<PathBuf>,
    /// Firmware that takes signed packages only: with the operator's private key all packages are
    /// signed with it; with the public key nodes wait until signed ones are pushed
    #[arg(long, value_name = "KEY.pem")]
    key: Option<PathBuf>,
    #[command(flatten)]
    passphrase: Passphrase,
    #[command(flatten)]
    pub(super) common: Common,
}

/// A time that a person can wait, and a node can keep. \[s\]
fn timeout(text: &str) -> Result<f64, String> {
    number_in(text, 1e-3, 1e6)
}

/// From a step in some minutes to faster than any emulator is.
fn speed(text: &str) -> Result<f64, String> {
    number_in(text, 1e-3, 1e6)
}

/// A number from `low` to `high`.
fn number_in(text: &str, low: f64, high: f64) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (low..=high).contains(number));
    number.ok_or_else(|| format!("write a number from {low} to {high}"))
}

/// Steps of a run that is to have no end: so many days that nobody sees it.
const ENDLESS: u64 = 1 << 40;

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    interruption::listen(Again::Wait);
    let mut scenario = scenario(arguments)?;
    let endpoints =
        for_agents(&arguments.boards, scenario.agents.len()).map_err(CommandError::usage)?;
    let step = StepCheck::new(&scenario);
    if !step.is_stable() {
        warnings::print(&[Warning::new(WarningCode::UnstableStep, step.describe())]);
    }
    // What can be refused is refused before anything is built.
    crate::cosim::prepared(&scenario)?;
    let timeout = Duration::from_secs_f64(arguments.timeout);
    let signing = Signing::read(arguments.key.as_deref(), &arguments.passphrase)?;
    let is_emulated = |index: usize| !matches!(endpoints[index], Endpoint::At(_));
    let emulated = (0..endpoints.len()).any(is_emulated);
    let qemu = emulated.then(|| emulator(arguments, &signing, timeout)).transpose()?;
    let emulators = match (qemu, &arguments.keep) {
        (None, _) => None,
        (Some(qemu), None) => Some((qemu, FlashFolder::temporary()?)),
        (Some(qemu), Some(folder)) => {
            let flash = FlashFolder::kept(folder)?;
            flash.take_over(&mut scenario, &qemu, signing.public_key(), is_emulated)?;
            Some((qemu, flash))
        }
    };
    let start = &mut |index: usize, package: &PackageBytes| {
        let package = (!signing.is_public_only()).then_some(package);
        let emulated = |(qemu, flash): &(Qemu, FlashFolder), channel| {
            qemu.start_on(channel, package, &flash.file(index), flash.removed())
        };
        let board = match (&endpoints[index], &emulators) {
            (Endpoint::Qemu, Some(emulators)) => emulated(emulators, Channel::Pipes),
            (Endpoint::QemuUart, Some(emulators)) => emulated(emulators, Channel::Uart),
            (Endpoint::At(address), _) => address
                .connect(interruption::stop())
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
    let endless = arguments.serve.is_some() && arguments.steps.is_none();
    let bars = match endless {
        true => ProgressBars::endless("co-simulating"),
        false => ProgressBars::new("co-simulating"),
    };
    let done = AtomicU64::new(0);
    let progress = SharedProgress::new(&bars, &done, scenario.steps());
    let quiet = arguments.common.format == Format::Json;
    let notice = &mut |notice: &Notice<'_>| {
        if !(quiet && matches!(notice, Notice::Reachable)) {
            let told = told(arguments, endpoints.len(), notice);
            let is_warning = matches!(notice, Notice::Ended(_) | Notice::Late { .. });
            bars.suspended(|| {
                if is_warning { terminal::warning(&told) } else { terminal::note(&told) }
            });
        }
    };
    let mut setup = Setup::new(start, timeout, interruption::stop());
    setup.signer = signing.signer();
    setup.erased = signing.is_public_only();
    if arguments.serve.is_some() {
        setup.notice = Some(notice);
    }
    let report = cosimulate(&scenario, arguments.common.seed, setup, service.as_ref(), &progress)?;
    bars.finish();
    let outcome = outcome(&report, scenario.steps());
    match arguments.common.format {
        Format::Json => print_outcome(&report, outcome),
        Format::Text => {
            let printed = print_text(&text(&scenario, arguments, &report));
            // Mismatches count, whether anyone reads of them or not.
            outcome.and(printed)
        }
    }
}

/// Whether it went well: equal bits, and every node to the end.
fn outcome(report: &CosimReport, wanted: u64) -> Result<(), CommandError> {
    if let Some(first) = &report.first_mismatch {
        return Err(CommandError::new(
            ErrorCode::Mismatches,
            format!(
                "{} steps of nodes differ from the simulated ones, first {first}",
                report.mismatches
            ),
        ));
    }
    let ended = report.boards.iter().filter(|board| board.ended.is_some());
    let ended: Vec<_> = ended.map(|board| board.agent.to_string()).collect();
    if !ended.is_empty() {
        return Err(CommandError::new(
            ErrorCode::Node,
            format!(
                "these agents' nodes have ended and were not started again: {}; see above why",
                ended.join(", ")
            ),
        ));
    }
    if report.interrupted {
        return Err(CommandError::new(
            ErrorCode::Interrupted,
            format!("interrupted after {} of {wanted} steps, all equal until then", report.steps),
        ));
    }
    Ok(())
}

/// What a notice says to people.
fn told(arguments: &Arguments, agents: usize, notice: &Notice<'_>) -> String {
    match notice {
        Notice::Reachable => served(arguments, agents),
        Notice::Ended(error) => {
            let again = arguments.serve.as_ref().map_or(String::new(), |folder| {
                let socket = folder.join(format!("agent-{}.sock", error.agent));
                format!(
                    "\nThe others go on; `host-sim node {} reset` starts it again",
                    shell_word(&socket)
                )
            });
            format!("{error}{again}")
        }
        Notice::StartedAgain { agent } => {
            format!("Agent {agent} has been started again, with what its flash holds")
        }
        Notice::Late { share } => format!(
            "real time is not kept, only {:.0} % of the speed that was asked for; choose a lower \
             --speed, or fewer nodes",
            share * 100.0
        ),
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
            return Err(CommandError::usage(format!(
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

fn emulator(
    arguments: &Arguments,
    signing: &Signing,
    timeout: Duration,
) -> Result<Qemu, CommandError> {
    let (program, memory) = (arguments.firmware.as_deref(), arguments.memory.as_deref());
    let say = |line: &str| terminal::note(line);
    let Firmware { program, memory } =
        firmware::find(program, memory, signing.public_key(), say, interruption::stop())?;
    let region = MemoryMap::read(&memory)?.weights()?;
    let stop = interruption::stop().clone();
    Ok(Qemu { program: arguments.qemu.clone(), firmware: program, region, timeout, stop })
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
        let agent = board.agent;
        if let Some(parted) = &board.parted {
            let _ = writeln!(text, "Agent {agent} is not compared {parted}");
        }
        if let Some(ended) = &board.ended {
            let _ = writeln!(text, "Agent {agent} has ended {ended}");
        }
        if board.restarts > 0 {
            let _ = writeln!(text, "Agent {agent} was started again: {}", board.restarts);
        }
    }
    if let Some(share) = report.real_time_kept.filter(|share| *share < 1.0) {
        let share = share * 100.0;
        let _ = writeln!(text, "Real time was not kept: {share:.1} % of the speed asked for");
    }
    let _ = writeln!(
        text,
        "\nEstimate, outer weights, derivative, outcome, trigger and frame compared in every step, bit for \
         bit: {}\n\
         {} steps in {:.2} s, {:.0} a second ({:.0} round trips)\n\
         Scenario {}, seed {}, digest {}",
        match report.mismatches {
            0 if report.boards.iter().all(|board| board.compared == 0) => {
                "no step was compared".to_owned()
            }
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
