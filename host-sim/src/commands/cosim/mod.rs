//! `cosim`: runs a scenario together with emulated or real nodes.

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
    Changes, CommandError, Common, ErrorCode, Format, SharedProgress, load_scenario, print_outcome,
    print_text,
};
use crate::analysis::StepCheck;
use crate::commands::progress::ProgressBars;
use crate::cosim::endpoint::{Endpoint, for_agents};
use crate::cosim::fault::{Fault, NodeError};
use crate::cosim::firmware::{self, Firmware};
use crate::cosim::qemu::{Channel, PROGRAM, Qemu};
use crate::cosim::{CosimReport, Notice, Service, Setup, board::Board, cosimulate};
use crate::interruption::{self, SecondSignal};
use crate::keys::FleetKeys;
use crate::memory_map::MemoryMap;
use crate::packages::PackageBytes;
use crate::plant::{Disturbance, RandomDisturbance};
use crate::scenario::Scenario;
use crate::shell::shell_word;
use crate::signing::KeyFileError;
use crate::terminal;
use crate::warning::{Warning, WarningCode};

/// Arguments of `cosim`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Scenario: a TOML file or the name of a built-in scenario
    #[arg(default_value = "paper")]
    scenario: PathBuf,
    #[command(flatten)]
    changes: Changes,
    /// Boards, one for all agents or one per agent: qemu (pipes, fastest), qemu-uart (emulated
    /// serial line), serial:/dev/tty...[@BAUD] (real board), unix:PATH
    #[arg(long, value_delimiter = ',', default_value = "qemu")]
    boards: Vec<Endpoint>,
    /// Number of steps [default: the whole scenario; with --serve, unlimited]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=ENDLESS))]
    steps: Option<u64>,
    /// Training recipe for all learning cycles [default: the one each cycle names]
    #[arg(long)]
    recipe: Option<String>,
    /// Skip the scenario's learning cycles
    #[arg(long)]
    without_learning: bool,
    /// Firmware of emulated nodes [default: the one built by `cargo xtask firmware --board
    /// qemu-mps2-an386` in the current project, else the one installed by `cargo xtask install`]
    #[arg(long, value_name = "ELF")]
    firmware: Option<PathBuf>,
    /// Memory map the firmware was linked with [default: memory.x of the project or installation]
    #[arg(long, value_name = "MEMORY.X")]
    memory: Option<PathBuf>,
    /// Emulator program
    #[arg(long, default_value = PROGRAM)]
    qemu: PathBuf,
    /// How long to wait for a node's reply [s]
    #[arg(long, default_value_t = 10.0, value_parser = timeout)]
    timeout: f64,
    /// Run in real time and serve every node at FOLDER/agent-N.sock, for `monitor`, `push` and
    /// `node`
    #[arg(long, value_name = "FOLDER")]
    serve: Option<PathBuf>,
    /// With --serve: speed relative to real time
    #[arg(long, default_value_t = 1.0, requires = "serve", value_parser = speed)]
    speed: f64,
    /// Keep the flash of emulated nodes in this folder, for the next run to start from [default:
    /// erased flash, holding the scenario's packages]
    #[arg(long, value_name = "FOLDER")]
    keep: Option<PathBuf>,
    /// Use firmware that accepts only signed packages. Given the operator's private key, all
    /// packages are signed with it; given the public key, nodes wait for signed packages to be
    /// pushed
    #[arg(long, value_name = "KEY.pem")]
    key: Option<PathBuf>,
    /// Give every node a port key and network keys of its own for this run: nodes then broadcast
    /// authentic frames
    #[arg(long, conflicts_with = "keys")]
    network_key: bool,
    /// Give every node the keys in this folder, as created by `keygen`, and use firmware that accepts
    /// only packages signed by its operator
    #[arg(long, value_name = "FOLDER", conflicts_with = "key")]
    keys: Option<PathBuf>,
    #[command(flatten)]
    passphrase: Passphrase,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    #[command(flatten)]
    pub(super) common: Common,
}

/// Parses a timeout. \[s\]
fn timeout(text: &str) -> Result<f64, String> {
    number_in(text, 1e-3, 1e6)
}

/// Parses a speed, relative to real time.
fn speed(text: &str) -> Result<f64, String> {
    number_in(text, 1e-3, 1e6)
}

/// Parses a number from `low` to `high`.
fn number_in(text: &str, low: f64, high: f64) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (low..=high).contains(number));
    number.ok_or_else(|| format!("expected a number from {low} to {high}"))
}

/// Number of steps of an unlimited run: years, even at the shortest step.
const ENDLESS: u64 = 1 << 40;

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let format = arguments.format;
    interruption::listen(SecondSignal::Wait);
    let mut scenario = scenario(arguments)?;
    let endpoints =
        for_agents(&arguments.boards, scenario.agents.len()).map_err(CommandError::usage)?;
    let step = StepCheck::new(&scenario);
    if !step.is_stable() {
        warnings::print(&[Warning::new(WarningCode::UnstableStep, step.describe())]);
    }
    // Reject bad input before building firmware.
    crate::cosim::prepared(&scenario)?;
    let timeout = Duration::from_secs_f64(arguments.timeout);
    let folder = arguments.keys.as_deref().map(|path| arguments.passphrase.folder(path));
    let folder = folder.transpose()?;
    let signing = match &folder {
        Some(folder) => Signing::of_folder(folder, &arguments.passphrase)?,
        None => Signing::read(arguments.key.as_deref(), &arguments.passphrase)?,
    };
    let keys = match folder {
        Some(folder) => Some(folder.fleet().clone()),
        None if arguments.network_key => Some(FleetKeys::generate().map_err(KeyFileError::Random)?),
        None => None,
    };
    let is_emulated = |index: usize| !matches!(endpoints[index], Endpoint::At(_));
    let is_served = arguments.serve.is_some();
    if scenario.life.iter().any(|downtime| is_served || !is_emulated(downtime.agent)) {
        return Err(crate::cosim::CosimError::Life { scenario: scenario.name }.into());
    }
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
            (_, None) => Err(Fault::Start("the emulator is not running".to_owned())),
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
    let quiet = format == Format::Json;
    let notice = &mut |notice: &Notice<'_>| {
        if !(quiet && matches!(notice, Notice::Reachable)) {
            let text = notice_text(arguments, endpoints.len(), notice);
            let is_warning = matches!(notice, Notice::Ended(_) | Notice::Late { .. });
            bars.suspended(|| {
                if is_warning { terminal::warning(&text) } else { terminal::note(&text) }
            });
        }
    };
    let mut setup = Setup::new(start, timeout, interruption::stop());
    setup.signer = signing.signer();
    setup.keys = keys.as_ref();
    setup.erased = signing.is_public_only();
    let remove_flash = |index: usize| match &emulators {
        Some((_, flash)) => std::fs::remove_file(flash.file(index)),
        None => Ok(()),
    };
    if !setup.erased {
        setup.remove_flash = Some(&remove_flash);
    }
    if arguments.serve.is_some() {
        setup.notice = Some(notice);
    }
    let report = cosimulate(&scenario, arguments.common.seed, setup, service.as_ref(), &progress)?;
    bars.finish();
    let outcome = outcome(&report, scenario.steps());
    match format {
        Format::Json => print_outcome(&report, outcome),
        Format::Text => {
            let printed = print_text(&text(&scenario, arguments, &report));
            // Mismatches take precedence over a failure to print.
            outcome.and(printed)
        }
    }
}

/// Returns an error if a step differed, a node ended early, or the run was interrupted.
fn outcome(report: &CosimReport, wanted: u64) -> Result<(), CommandError> {
    if let Some(first) = &report.first_mismatch {
        return Err(CommandError::new(
            ErrorCode::Mismatches,
            format!("{} node steps differ from the simulation; first {first}", report.mismatches),
        ));
    }
    let ended = report.boards.iter().filter(|board| board.ended.is_some());
    let ended: Vec<_> = ended.map(|board| board.agent.to_string()).collect();
    if !ended.is_empty() {
        return Err(CommandError::new(
            ErrorCode::Node,
            format!(
                "the nodes of these agents stopped and were not restarted: {}; see the reasons above",
                ended.join(", ")
            ),
        ));
    }
    if report.interrupted {
        return Err(CommandError::new(
            ErrorCode::Interrupted,
            format!("interrupted after {} of {wanted} steps, all of them equal", report.steps),
        ));
    }
    Ok(())
}

/// Returns the text of a notice.
fn notice_text(arguments: &Arguments, agents: usize, notice: &Notice<'_>) -> String {
    match notice {
        Notice::Reachable => served(arguments, agents),
        Notice::Ended(error) => {
            let restart = arguments.serve.as_ref().map_or(String::new(), |folder| {
                let socket = folder.join(format!("agent-{}.sock", error.agent));
                format!(
                    "\nThe other nodes continue; restart this one with `host-sim node {} reset`",
                    shell_word(&socket)
                )
            });
            format!("{error}{restart}")
        }
        Notice::Restarted { agent } => {
            format!("Agent {agent} was restarted from the contents of its flash")
        }
        Notice::Late { share } => format!(
            "running at only {:.0} % of the requested speed; choose a lower --speed, or fewer nodes",
            share * 100.0
        ),
    }
}

/// Returns how to reach the nodes.
fn served(arguments: &Arguments, agents: usize) -> String {
    let Some(folder) = &arguments.serve else { return String::new() };
    let keys = arguments.keys.as_ref();
    let keys = keys.map_or(String::new(), |folder| format!(" --keys {}", shell_word(folder)));
    let socket = shell_word(&folder.join("agent-1.sock"));
    let others = if agents > 1 { format!(", agents 1 to {agents}") } else { String::new() };
    format!(
        "Nodes can be reached until Ctrl-C{others}:\n  host-sim monitor {socket}{keys}\n  host-sim push \
         {socket} PACKAGE{keys}\n  host-sim node {socket} status"
    )
}

fn scenario(arguments: &Arguments) -> Result<Scenario, CommandError> {
    let mut scenario = load_scenario(&arguments.scenario, &arguments.changes)?;
    if let Some(recipe) = &arguments.recipe {
        if scenario.recipe(recipe).is_none() {
            let names: Vec<_> = scenario.recipes.iter().map(|r| r.name.as_str()).collect();
            return Err(CommandError::usage(format!(
                "--recipe {recipe}: not a recipe of scenario {}; choose one of {}",
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
    scenario.run_steps = arguments.steps.or(endless);
    let is_endless = arguments.steps.is_none() && endless.is_some();
    if is_endless && matches!(scenario.disturbance, Disturbance::Random(_)) {
        let problem = "--serve: a random disturbance is drawn for a known number of steps; give --steps, or remove \
                       [disturbance]";
        return Err(CommandError::usage(problem));
    }
    let most = RandomDisturbance::NUMBERS_MAX / scenario.dimension() as u64;
    if scenario.steps() > most && matches!(scenario.disturbance, Disturbance::Random(_)) {
        let problem = format!(
            "--steps: a random disturbance is drawn before the run, for at most {most} steps"
        );
        return Err(CommandError::usage(problem));
    }
    Ok(scenario.drawn(arguments.common.seed).into_owned())
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
            let _ = writeln!(text, "Agent {agent} stopped {ended}");
        }
        if board.restarts > 0 {
            let _ = writeln!(text, "Agent {agent} restarts: {}", board.restarts);
        }
    }
    if let Some(share) = report.real_time_kept.filter(|share| *share < 1.0) {
        let share = share * 100.0;
        let _ = writeln!(text, "Ran at {share:.1} % of the requested speed");
    }
    let _ = writeln!(
        text,
        "\nEstimate, outer weights, derivative, outcome, trigger and frame, compared bit for bit in every \
         step: {}\n\
         {} steps in {:.2} s, {:.0} per second ({:.0} round trips)\n\
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
