//! The node as a task of embassy's executor, alongside other tasks (feature `embassy`).
//!
//! `Node::run` owns the processor. Here the executor does: the node's task polls it, yields after
//! each piece of work, and waits while there is none. [`blink`] stands for your own tasks.
//!
//! A task gets the processor when the node yields, so it can be late by one piece of the node's
//! work: a step, or the check of a package. While flash is erased, nothing runs.
//!
//! Time comes from SysTick, because the HAL has no time driver: one interrupt each 0.1 ms. A step can
//! therefore begin up to 0.2 ms late. The node's periods are still counted by TIM2, so none is lost.

use core::task::Waker;

use cortex_m::peripheral::{SCB, SYST, syst::SystClkSource};
use cortex_m_rt::exception;
use embassy_executor::{Executor, task};
use embassy_futures::{select::select, yield_now};
use embassy_sync::{blocking_mutex::raw::CriticalSectionRawMutex, signal::Signal};
use embassy_time::{Delay, Duration, TICK_HZ, Ticker, Timer};
use embassy_time_driver::{Driver, time_driver_impl};
use embassy_time_queue_utils::Queue;
use firmware_template::Progress;
use firmware_template::on_chip::Shared;
use hal::gpio::{Output, PC1};
use static_cell::StaticCell;
use stm32f4xx_hal as hal;

use crate::{ThisBoard, ThisNode};

/// Time allowed for sending the service port's queue before a reset.
const FLUSH_DELAY: Duration = Duration::from_millis(200);
/// Half a period of the LED.
const BLINK: Duration = Duration::from_millis(500);

static EXECUTOR: StaticCell<Executor> = StaticCell::new();

/// A byte has arrived at the service port.
pub(crate) static SERVICE_INPUT: Signal<CriticalSectionRawMutex, ()> = Signal::new();

/// Runs the node and the other tasks.
pub(crate) fn run(
    node: &'static mut ThisNode,
    board: &'static mut ThisBoard,
    led: PC1<Output>,
) -> ! {
    EXECUTOR.init_with(Executor::new).run(|spawner| {
        // A task can be spawned once, and these are.
        if let (Ok(node), Ok(blink)) = (run_node(node, board), blink(led)) {
            spawner.spawn(node);
            spawner.spawn(blink);
        }
    })
}

#[task]
async fn run_node(node: &'static mut ThisNode, board: &'static mut ThisBoard) {
    loop {
        match node.poll(board) {
            Progress::Worked => yield_now().await,
            Progress::Idle => {
                let next_period = Timer::after_micros(board.clock().until_next());
                select(next_period, SERVICE_INPUT.wait()).await;
            }
            Progress::Reset => break,
        }
    }
    Timer::after(FLUSH_DELAY).await;
    SCB::sys_reset()
}

/// Blinks the board's red LED.
#[task]
async fn blink(mut led: PC1<Output>) {
    let mut ticker = Ticker::every(BLINK);
    loop {
        led.toggle();
        ticker.next().await;
    }
}

/// Starts embassy's time on a core of this frequency \[Hz\]; returns a delay for drivers, which
/// waits without yielding.
pub(crate) fn start_time(mut timer: SYST, frequency: u32) -> Delay {
    TIME.0.set(Time { ticks: 0, alarm: u64::MAX, queue: Queue::new() });
    timer.set_clock_source(SystClkSource::Core);
    timer.set_reload(frequency / TICK_HZ as u32 - 1);
    timer.clear_current();
    timer.enable_interrupt();
    timer.enable_counter();
    Delay
}

struct Time {
    ticks: u64,
    /// Tick of the next expiration.
    alarm: u64,
    queue: Queue,
}

impl Time {
    /// Wakes the tasks whose time has come.
    fn expire(&mut self) {
        self.alarm = self.queue.next_expiration(self.ticks);
    }
}

struct SysTickDriver(Shared<Time>);

impl Driver for SysTickDriver {
    fn now(&self) -> u64 {
        self.0.with(|time| time.ticks).unwrap_or(0)
    }

    fn schedule_wake(&self, at: u64, waker: &Waker) {
        self.0.with(|time| {
            if time.queue.schedule_wake(at, waker) {
                time.expire();
            }
        });
    }
}

time_driver_impl!(static TIME: SysTickDriver = SysTickDriver(Shared::new()));

#[exception]
fn SysTick() {
    TIME.0.with(|time| {
        time.ticks += 1;
        if time.ticks >= time.alarm {
            time.expire();
        }
    });
}
