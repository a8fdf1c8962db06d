//! Runs one small study in every way that `host-sim/examples/studies` shows, and compares the tables:
//! in one go, as the tasks of a Slurm array, with GNU parallel, and on a Dask cluster of a scheduler
//! and two workers. All must have the same bytes.
//!
//! Slurm itself is not started: its script is run with the variables that Slurm sets. Dask is installed
//! into `target/studies/python` by pip.

use std::{
    collections::BTreeSet,
    fs,
    net::TcpListener,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
};

use crate::{
    host::simulator,
    packages,
    step::{Failure, ask, run, run_reading, target_folder, workspace},
};

/// The study: a second of the paper's experiment, without learning; 12 cells with two seeds.
const STUDY: [&str; 16] = [
    "paper",
    "--set",
    "learning=[]",
    "--set",
    "time.duration=1",
    "--set",
    "evaluation={ from = 0.5, to = 1.0 }",
    "--set",
    "link.loss=0.1",
    "--vary",
    "design.epsilon=1000:9000:log6",
    "--vary",
    "design.gain.scale=0.9,1",
    "--seeds",
    "2",
    "--format=json",
];

/// Number of parts.
const PARTS: &str = "5";

/// Runs the study in all ways.
///
/// # Errors
/// A run fails, a table differs, or something required is missing.
pub(crate) fn studies(debian: bool) -> Result<(), Failure> {
    require(debian)?;
    let program = simulator()?;
    let folder = target_folder().join("studies");
    let results = folder.join("results");
    // Left by an earlier call, which would otherwise be continued.
    let _ = fs::remove_dir_all(&results);
    let study = Study { program, scripts: workspace().join("host-sim/examples/studies"), results };
    study.in_one_go()?;
    study.slurm()?;
    study.parallel()?;
    study.dask(&folder.join("python"))?;
    println!(
        "studies: in 5 parts, with the Slurm script, GNU parallel and Dask: the same bytes as in a single run"
    );
    Ok(())
}

/// Installs what is missing, if that is allowed.
fn require(debian: bool) -> Result<(), Failure> {
    let has_venv = ask(Command::new("python3").args(["-c", "import ensurepip, venv"])).is_some();
    let is_gnu = ask(Command::new("parallel").arg("--version"))
        .is_some_and(|version| version.starts_with("GNU parallel"));
    let missing: Vec<&str> = [(has_venv, "python3-venv"), (is_gnu, "parallel")]
        .into_iter()
        .filter_map(|(is_there, package)| (!is_there).then_some(package))
        .collect();
    if missing.is_empty() {
        return Ok(());
    }
    if packages::allowed(debian) {
        return packages::install(&missing);
    }
    let names = missing.join(" ");
    Err(Failure::new(format!("not found: {names}"), format!("sudo apt-get install {names}")))
}

struct Study {
    program: PathBuf,
    scripts: PathBuf,
    results: PathBuf,
}

impl Study {
    fn folder(&self, name: &str) -> PathBuf {
        self.results.join(name)
    }

    fn in_one_go(&self) -> Result<(), Failure> {
        let mut command = Command::new(&self.program);
        command.arg("sweep").args(STUDY).arg("--out").arg(self.folder("whole"));
        run("in one go", &mut command, "see the error above")
    }

    fn slurm(&self) -> Result<(), Failure> {
        let folder = self.folder("slurm");
        let mut table = Vec::new();
        for number in 1..=PARTS.parse().unwrap_or(1) {
            let mut command = self.script("slurm.sh", &folder);
            command.env("SLURM_ARRAY_TASK_ID", number.to_string());
            command.env("SLURM_ARRAY_TASK_COUNT", PARTS);
            run("Slurm's script", &mut command, "see the error above")?;
            table.extend(read(&folder.join(format!("shard-{number}/results.csv")))?);
        }
        let merged = folder.join("results.csv");
        fs::write(&merged, table).map_err(|error| failed(&merged, &error))?;
        let mut command = Command::new(&self.program);
        command.args(["sweep", "--summarise"]).arg(merged);
        run("its summary", &mut command, "see the error above")?;
        self.compare("slurm")
    }

    fn parallel(&self) -> Result<(), Failure> {
        let folder = self.folder("parallel");
        let mut command = Command::new("sh");
        command.arg(self.scripts.join("parallel.sh")).arg(PARTS).arg(folder).args(STUDY);
        command.env("HOST_SIM", &self.program);
        run("GNU parallel", &mut command, "see the error above")?;
        self.compare("parallel")
    }

    fn dask(&self, python: &Path) -> Result<(), Failure> {
        if !python.join("bin/dask").exists() {
            let mut command = Command::new("python3");
            let hint = "Python 3.10 or newer with the venv module is needed";
            run("Python", command.args(["-m", "venv"]).arg(python), hint)?;
        }
        let mut install = Command::new(python.join("bin/pip"));
        install.args(["install", "--quiet", "--disable-pip-version-check", "--requirement"]);
        install.arg(self.scripts.join("requirements.txt"));
        run("Dask", &mut install, "check that pip can install packages here")?;
        let port = free_port()?;
        let address = format!("tcp://127.0.0.1:{port}");
        let log = self.results.join("dask.log");
        let start = |arguments: &[&str]| {
            let mut command = Command::new(python.join("bin/dask"));
            Background::start(command.args(arguments).current_dir(&self.results), &log)
        };
        let port = port.to_string();
        let _scheduler = start(&[
            "scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            &port,
            "--no-dashboard",
            "--no-show",
        ])?;
        let worker = ["worker", &address, "--no-nanny", "--nthreads", "1", "--no-dashboard"];
        let _workers = [start(&worker)?, start(&worker)?];
        let hint = format!("see {}", log.display());
        let mut wait = Command::new(python.join("bin/python"));
        wait.args([
            "-c",
            "import distributed, sys; \
             distributed.Client(sys.argv[1], timeout=60).wait_for_workers(2, timeout=60)",
        ]);
        run("scheduler and two workers", wait.arg(&address), &hint)?;
        let mut command = Command::new(python.join("bin/python"));
        command.arg(self.scripts.join("dask_sweep.py")).args([&address, PARTS]);
        command.arg(self.folder("dask")).args(STUDY).env("HOST_SIM", &self.program);
        let mut workers = BTreeSet::new();
        run_reading("Dask", &mut command, &hint, |line| {
            workers.extend(line.split_once("this one on ").map(|(_, worker)| worker.to_owned()));
        })?;
        if workers.len() != 2 {
            let what = format!("Dask: {} workers took part, expected 2", workers.len());
            return Err(Failure::new(what, hint));
        }
        self.compare("dask")
    }

    /// Prepares a script that runs parts into `folder`.
    fn script(&self, name: &str, folder: &Path) -> Command {
        let mut command = Command::new("sh");
        command.arg(self.scripts.join(name)).arg(folder).args(STUDY);
        command.env("HOST_SIM", &self.program);
        command
    }

    /// Compares table, summary and picture with those of one go.
    fn compare(&self, name: &str) -> Result<(), Failure> {
        for file in ["results.csv", "summary.csv", "tradeoff.svg", "tradeoff.png"] {
            let [whole, other] = ["whole", name].map(|name| self.folder(name).join(file));
            if read(&whole)? != read(&other)? {
                let what = format!("{} and {} differ", whole.display(), other.display());
                return Err(Failure::new(
                    what,
                    "results must not depend on how a study is divided",
                ));
            }
        }
        Ok(())
    }
}

/// A process that is ended with this.
struct Background(Child);

impl Background {
    fn start(command: &mut Command, log: &Path) -> Result<Self, Failure> {
        let open = || fs::OpenOptions::new().create(true).append(true).open(log);
        let [output, errors] = [open(), open()].map(|file| file.map_err(|e| failed(log, &e)));
        command.stdin(Stdio::null()).stdout(output?).stderr(errors?);
        let name = command.get_program().to_string_lossy().into_owned();
        let child = command.spawn().map_err(|error| failed(Path::new(&name), &error))?;
        Ok(Self(child))
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn free_port() -> Result<u16, Failure> {
    let port = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
    port.map(|address| address.port())
        .map_err(|error| Failure::new(format!("no free port: {error}"), "check the network"))
}

fn read(path: &Path) -> Result<Vec<u8>, Failure> {
    fs::read(path).map_err(|error| failed(path, &error))
}

fn failed(path: &Path, error: &std::io::Error) -> Failure {
    Failure::new(format!("{}: {error}", path.display()), "check that it is readable and writable")
}
