//! The memory map parser: the repository's own map, the language, and every message.

use std::path::Path;

use host_sim::memory_map::{MemoryMap, MemoryMapError, WeightsRegion};
use proptest::prelude::*;

/// The memory map of the default board.
pub(crate) const MEMORY_X: &str = include_str!("../../memory.x");

/// The region of that map as the linker computes it: GNU ld 2.40 on a file that includes
/// it, symbols printed by `nm`.
pub(crate) const WEIGHTS: WeightsRegion = WeightsRegion {
    origin: 0x2100_0000,
    length: 64 << 10,
    slot_a: 0x2100_0000,
    slot_b: 0x2100_7000,
    slot_length: 28 << 10,
    commit: 0x2100_E000,
    commit_length: 8 << 10,
    erase_size: 4 << 10,
};

fn parse(text: &str) -> Result<MemoryMap, MemoryMapError> {
    MemoryMap::parse(text, "map.x")
}

/// Returns the value of an expression that follows two regions and a symbol.
fn value(expression: &str) -> Result<u64, String> {
    let text = format!(
        "MEMORY {{ A : ORIGIN = 16, LENGTH = 4K B (rx!w) : org = ORIGIN(A) + LENGTH(A) l = 1M }}\n\
         earlier = 7; result = {expression};"
    );
    match parse(&text) {
        Ok(map) => match (map.symbol("result"), map.unresolved.last()) {
            (Some(symbol), _) => Ok(symbol.value),
            (None, Some(error)) => Err(error.to_string()),
            (None, None) => panic!("result has neither a value nor a reason"),
        },
        Err(error) => Err(error.to_string()),
    }
}

#[test]
fn repository_map_matches_the_linker() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../memory.x");
    let map = MemoryMap::read(&path).unwrap();
    let regions: Vec<_> = map
        .regions
        .iter()
        .map(|region| (region.name.as_str(), region.origin, region.length))
        .collect();
    let expected = [
        ("FLASH", 0, 4 << 20),
        ("RAM", 0x2000_0000, 128 << 10),
        ("WEIGHTS", 0x2100_0000, 64 << 10),
    ];
    assert_eq!(regions, expected);
    assert_eq!(map.weights(), Ok(WEIGHTS));
}

#[test]
fn every_boards_map_can_be_read_and_its_parts_are_erasable() {
    let boards = Path::new(env!("CARGO_MANIFEST_DIR")).join("../firmware-template/boards");
    let mut read = 0;
    for entry in std::fs::read_dir(boards).unwrap() {
        let path = entry.unwrap().path().join("memory.x");
        if path.exists() {
            let map = MemoryMap::read(&path).unwrap();
            let weights =
                map.weights().unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            assert!(weights.layout().slot_length >= 28 << 10, "{}", path.display());
            read += 1;
        }
    }
    assert!(read >= 4, "{read} maps");
}

#[test]
fn expressions_match_the_linker() {
    for (expression, expected) in [
        ("1 + 2 * 3", 7),
        ("(1 + 2) * 3", 9),
        ("20 - 5 - 3", 12),
        ("100 / 10 / 2", 5),
        ("0x17 % 16 * 2", 14),
        ("2k - 0x1K", 1024),
        ("earlier * earlier", 49),
        ("ORIGIN(A) + LENGTH ( A )", 4112),
        ("ORIGIN(B)", 4112),
        ("LENGTH(B)", 1 << 20),
        ("1 + 1 == 2", 1),
        ("3 < 2", 0),
        ("3 <= 3", 1),
        ("4 > 3 != 0", 1),
        ("2 >= 3", 0),
        ("/* a */ 1 /* b\n */ + /**/ 1", 2),
        ("1 << 4 + 1", 32),
        ("0x30 >> 4 & 1 | 4", 5),
        ("6 ^ 3", 5),
        ("(0x12345 + 0xFFF) & ~0xFFF", 0x13000),
        ("1 ? 2 : 3", 2),
        ("0 || 0 ? 2 : 1 && 2 ? 4 : 5", 4),
        ("!0 + !7", 1),
        ("-1 & 0xFF", 0xFF),
        ("MAX(3, MIN(9, 5))", 5),
        ("ALIGN(ORIGIN(B), 4K)", 8192),
        ("ABSOLUTE(7)", 7),
        ("DEFINED(earlier) + 2 * DEFINED(later)", 1),
    ] {
        assert_eq!(value(expression), Ok(expected), "{expression}");
    }
}

#[test]
fn errors_name_invalid_expressions() {
    let deep = format!("{}1{}", "(".repeat(65), ")".repeat(65));
    for (expression, message) in [
        (
            "1 - 2",
            "map.x:2: result: 0x1 - 0x2 is negative; addresses and sizes must not be negative",
        ),
        ("8 / (4 - 4)", "map.x:2: result: 0x8 / 0x0 divides by 0; use another divisor"),
        (
            "0xFFFFFFFFFFFFFFFF + 1",
            "map.x:2: result: 0xffffffffffffffff + 0x1 overflows 64 bits; use smaller numbers",
        ),
        (
            "later",
            "map.x:2: result: symbol `later` is not defined before this line; define it further up",
        ),
        (
            "LENGTH(C)",
            "map.x:2: result: region `C` is not defined before this line; define it further up, in MEMORY",
        ),
        (
            "SIZEOF(.text)",
            "map.x:2: result: unsupported function `SIZEOF`; use ORIGIN(region) or LENGTH(region)",
        ),
        ("1 2", "map.x:2: result: found the number 2; expected `;` after the value"),
        (
            "1 + ;",
            "map.x:2: result: found `;`; expected a number, a symbol, ORIGIN(region), LENGTH(region) or `(`",
        ),
        ("(1", "map.x:2: result: found `;`; expected `)` after the expression"),
        ("1 << 64", "map.x:2: result: 0x1 << 0x40 overflows 64 bits; use smaller numbers"),
        ("4KB", "map.x:2: result: `4KB` is not a number; write it as 12, 0x1F, 64K or 3M"),
        (
            &deep,
            "map.x:2: result: more than 64 nested parentheses; move parts of the expression to separate symbols",
        ),
    ] {
        assert_eq!(value(expression), Err(message.to_owned()), "{expression}");
    }
}

#[test]
fn errors_name_line_and_fix() {
    const STATEMENTS: &str =
        "expected MEMORY { ... }, ASSERT(condition, \"message\"); or symbol = value;";
    for (text, message) in [
        ("\nSECTIONS { ", "map.x:2: SECTIONS: has an unclosed parenthesis or brace; close it".to_owned()),
        ("SECTIONS { .a : { *(.a) } > WEIGHTS }", "map.x:1: SECTIONS: places a section in WEIGHTS, where an update of the weights would erase it; place it in another region".to_owned()),
        ("REGION_ALIAS(\"X\", WEIGHTS);\nSECTIONS { .a : { *(.a) } > X AT> X }", "map.x:2: SECTIONS: places a section in WEIGHTS, where an update of the weights would erase it; place it in another region".to_owned()),
        ("\nFLASH RAM", format!("map.x:2: found `FLASH` followed by `RAM`; {STATEMENTS}")),
        ("a = 1;\n12 = 3;", format!("map.x:2: found the number 12; {STATEMENTS}")),
        ("a = 1;\na = 2;", "map.x:2: a: is already defined on line 1; define each symbol once".to_owned()),
        ("a = 1", "map.x:1: a: found the end of the file; expected `;` after the value".to_owned()),
        ("MEMORY {\n  A : ORIGIN = 0\n}", "map.x:3: A: found `}`; expected LENGTH = value (or len, or l)".to_owned()),
        ("MEMORY { A ORIGIN = 0 }", "map.x:1: A: found `ORIGIN`; expected `:` after the name of a region".to_owned()),
        ("MEMORY { A : o = 0, l = 1 A : o = 2, l = 1 }", "map.x:1: A: region is already defined on line 1; use a different name for each region".to_owned()),
        ("MEMORY { A : o = 4096M, l = 1 }", "map.x:1: A: ORIGIN is 0x100000000, which is not a 32-bit address; use an address below 0x100000000".to_owned()),
        ("MEMORY { A : o = 4095M, l = 2M }", "map.x:1: A: 0x200000 bytes from 0xfff00000 exceed the 32-bit address space; use a smaller LENGTH".to_owned()),
        ("MEMORY", "map.x:1: found the end of the file; expected `{` after MEMORY".to_owned()),
        ("a = 1;\nASSERT(a == 2, \"a has to be 2\")", "map.x:2: ASSERT: assertion failed: a has to be 2; change the regions or symbols in the condition".to_owned()),
        ("ASSERT(1)", "map.x:1: ASSERT: found `)`; expected `,` after the condition".to_owned()),
        ("ASSERT(1, a)", "map.x:1: ASSERT: found `a`; expected the message, in quotes".to_owned()),
        ("MEMORY { A : o = 0, l = 4KB }", "map.x:1: A: `4KB` is not a number; write it as 12, 0x1F, 64K or 3M".to_owned()),
    ] {
        assert_eq!(parse(text).unwrap_err().to_string(), message, "{text}");
    }
    let error = MemoryMap::read(Path::new("no/such/memory.x")).unwrap_err().to_string();
    assert!(error.starts_with("no/such/memory.x: cannot be read: "), "{error}");
    #[cfg(unix)]
    {
        let error = MemoryMap::read(Path::new("/dev/zero")).unwrap_err().to_string();
        assert!(error.contains("larger than 1048576 bytes"), "{error}");
    }
}

/// Returns the weights of the repository's map with one change and without its assertions, whose
/// violations must be detected without them.
fn changed(from: &str, to: &str) -> Result<WeightsRegion, String> {
    assert!(MEMORY_X.contains(from), "{from} is no longer in memory.x");
    let bare: String = MEMORY_X
        .lines()
        .filter(|line| !line.starts_with("ASSERT"))
        .map(|line| format!("{line}\n"))
        .collect();
    let map = parse(&bare.replacen(from, to, 1)).map_err(|error| error.to_string())?;
    map.weights().map_err(|error| error.to_string())
}

#[test]
fn detects_an_invalid_weights_region_without_assertions() {
    assert_eq!(changed("RAM     : ORIGIN", "RAM     : ORIGIN"), Ok(WEIGHTS));
    for (from, to, name, part) in [
        ("  WEIGHTS : ORIGIN", "  OTHER : ORIGIN", "WEIGHTS", "a region is required"),
        ("LENGTH = 4M", "LENGTH = 600M", "FLASH", "overlaps WEIGHTS"),
        ("LENGTH = 64K", "LENGTH = 60K", "_weights_commit_length", "WEIGHTS ends at 0x2100f000"),
        ("_weights_erase_size = 4K", "_other = 4K", "_weights_erase_size", "not defined"),
        ("_weights_erase_size = 4K", "_weights_erase_size = 0", "_weights_erase_size", "is 0"),
        (
            "_weights_erase_size = 4K",
            "_weights_erase_size = 8K",
            "_weights_slot_a_length",
            "not a multiple of 0x2000",
        ),
        (
            "_weights_slot_a_origin = ORIGIN(WEIGHTS)",
            "_weights_slot_a_origin = 0",
            "_weights_slot_a_origin",
            "before WEIGHTS",
        ),
        (
            "_weights_slot_a_origin = ORIGIN(WEIGHTS)",
            "_weights_slot_a_origin = ORIGIN(WEIGHTS) + 256",
            "_weights_slot_a_origin",
            "not a multiple of 0x1000",
        ),
        (
            "_weights_slot_a_length = 28K",
            "_weights_slot_a_length = 24K",
            "_weights_slot_b_length",
            "length of slot A",
        ),
        (
            "_weights_slot_a_length = 28K",
            "_weights_slot_a_length = 0",
            "_weights_slot_a_length",
            "is 0",
        ),
        (
            "_weights_commit_length = 8K",
            "_weights_commit_length = 0xFFFFFFFFFFFFF000",
            "_weights_commit_length",
            "WEIGHTS ends at 0x21010000",
        ),
        (
            "_weights_slot_b_origin = _weights_slot_a_origin + _weights_slot_a_length",
            "_weights_slot_b_origin = _weights_slot_a_origin + 4K",
            "_weights_slot_b_origin",
            "overlaps slot A",
        ),
        (
            "_weights_commit_origin = _weights_slot_b_origin + _weights_slot_b_length",
            "_weights_commit_origin = _weights_slot_b_origin",
            "_weights_commit_origin",
            "overlaps slot B",
        ),
        (
            "_weights_commit_length = 8K",
            "_weights_commit_length = 4K",
            "_weights_commit_length",
            "only one erase unit",
        ),
    ] {
        let message = changed(from, to).unwrap_err();
        assert!(message.starts_with("map.x:"), "{message}");
        assert!(message.contains(name) && message.contains(part), "{to}: {message}");
    }
}

/// Statements of real boards' maps other than regions and symbols.
#[test]
fn skips_statements_unrelated_to_the_weights() {
    let standard = [
        // The RP2040 with its second-stage bootloader, as rp-hal writes it.
        "EXTERN(BOOT2_FIRMWARE)\nSECTIONS {\n  .boot2 ORIGIN(BOOT2) : { KEEP(*(.boot2)); } > BOOT2\n\
         } INSERT BEFORE .text;",
        // The RP2350's image definition.
        "SECTIONS { .start_block : ALIGN(4) { __start_block_addr = .; KEEP(*(.start_block)); } > FLASH\n\
         } INSERT AFTER .vector_table;\n_stext = ADDR(.start_block) + SIZEOF(.start_block);\n\
         PROVIDE(start_to_end = __end_block_addr - __start_block_addr);",
        // riscv-rt.
        "REGION_ALIAS(\"REGION_TEXT\", FLASH);\nREGION_ALIAS(\"REGION_DATA\", RAM);\n_heap_size = 1K;",
        // CubeMX and the C world.
        "ENTRY(Reset_Handler)\n_estack = ORIGIN(RAM) + LENGTH(RAM);\n_Min_Heap_Size = 0x200;\n\
         SECTIONS { .isr_vector : { . = ALIGN(4); KEEP(*(.isr_vector)) } >FLASH\n\
         /DISCARD/ : { libc.a ( * ) } .ARM.attributes 0 : { *(.ARM.attributes) } }",
        "OUTPUT_FORMAT(\"elf32-littlearm\", \"elf32-bigarm\", \"elf32-littlearm\")\nOUTPUT_ARCH(arm)",
        "GROUP(libgcc.a libc.a)\nINPUT(crt0.o)\nSEARCH_DIR(.)\nSTARTUP(a-b.o)",
        "PHDRS { text PT_LOAD FLAGS(5); }\nVERSION { V1 { global: *; }; }",
        "INCLUDE device.x\n. = 4;\n_x = 1 << 4;\n_x += 3;\n_y = _x ? 2 : 3; # a comment",
        "_stack_start = ORIGIN(RAM) + LENGTH(RAM) - 0x10;\n_stack_end = _ebss;\n_later = . + 4;",
        "ASSERT(SIZEOF(.text) <= LENGTH(FLASH), \"too long\");\nASSERT(1 << 2 == 4, \"no\")",
        "PROVIDE(_weights_slot_a_origin = 3);\nPROVIDE_HIDDEN(a = b);\nHIDDEN(c = 4);",
    ];
    for (number, text) in standard.into_iter().enumerate() {
        for map in
            [format!("{MEMORY_X}\n{text}\n"), format!("{MEMORY_X}\n{text}").replace('\n', "\r\n")]
        {
            let found = parse(&map).map_err(|error| error.to_string());
            let found = found.and_then(|map| map.weights().map_err(|error| error.to_string()));
            assert_eq!(found, Ok(WEIGHTS), "{number}: {text}");
        }
    }
    // Statements before MEMORY, and a byte order mark.
    let before = "\u{feff}OUTPUT_ARCH(riscv)\n_page = 1 << 12;\n";
    assert_eq!(parse(&format!("{before}{MEMORY_X}")).unwrap().weights(), Ok(WEIGHTS));
}

#[test]
fn reads_regions_in_every_style() {
    for text in [
        "MEMORY\n{\n  FLASH (rx)  : ORIGIN = 0x08000000, LENGTH = 512K\n  RAM (xrw) : ORIGIN = 0x20000000, LENGTH = 128K }",
        "MEMORY { FLASH(rx!w) : org = 0x8000000 len = 0x80000 RAM : o = 32768K * 16, l = 128k }",
        "base = 0x08000000;\nMEMORY { FLASH : ORIGIN = base + 0K, LENGTH = 1M / 2 \"RAM\" (rwx) : ORIGIN = 1 << 29, LENGTH = 128K - 0x0 }",
    ] {
        let map = parse(text).unwrap();
        let found: Vec<_> = map.regions.iter().map(|r| (r.origin, r.length)).collect();
        assert_eq!(found, [(0x0800_0000, 512 << 10), (0x2000_0000, 128 << 10)], "{text}");
    }
}

#[test]
fn error_says_why_a_symbol_has_no_value() {
    for (from, to, message) in [
        (
            "_weights_erase_size = 4K",
            "_weights_erase_size = SIZEOF(.x)",
            "_weights_erase_size: unsupported function `SIZEOF`; use ORIGIN(region) or LENGTH(region)",
        ),
        (
            "_weights_erase_size = 4K;",
            "INCLUDE sub/erase-size.x\n",
            "_weights_erase_size: not defined, but a symbol is required (INCLUDE is not \
             supported: sub/erase-size.x); define it by an assignment in this file",
        ),
    ] {
        let error = changed(from, to).unwrap_err();
        assert!(error.contains(message), "{error}");
    }
}

#[test]
fn rejects_a_part_of_a_gigabyte() {
    let text = "MEMORY { WEIGHTS : ORIGIN = 0, LENGTH = 2048M } _weights_erase_size = 4K;\n\
        _weights_slot_a_origin = 0; _weights_slot_a_length = 4K;\n\
        _weights_slot_b_origin = 4K; _weights_slot_b_length = 4K;\n\
        _weights_commit_origin = 8K; _weights_commit_length = 1024M;";
    let error = parse(text).unwrap().weights().unwrap_err().to_string();
    assert_eq!(
        error,
        "map.x:4: _weights_commit_length: the commit area has 0x40000000 bytes; shorten it to \
         at most 0x4000000; a package takes a few kilobytes"
    );
}

/// Checks the invariants of the result for any text.
fn sound(text: &str) -> Result<(), TestCaseError> {
    match parse(text) {
        Ok(map) => {
            for region in &map.regions {
                prop_assert!(region.end() <= 1 << 32);
            }
            if let Ok(weights) = map.weights() {
                prop_assert!(weights.erase_size > 0 && weights.end() <= 1 << 32);
                for (origin, length) in [
                    (weights.slot_a, weights.slot_length),
                    (weights.slot_b, weights.slot_length),
                    (weights.commit, weights.commit_length),
                ] {
                    prop_assert!(origin >= weights.origin);
                    prop_assert!(u64::from(origin) + u64::from(length) <= weights.end());
                    prop_assert_eq!(origin % weights.erase_size, 0);
                }
            }
        }
        Err(error) => {
            let lines = text.split('\n').count();
            prop_assert!(error.line.is_some_and(|line| (1..=lines).contains(&line)), "{}", error);
            prop_assert!(!error.problem.is_empty() && !error.hint.is_empty());
        }
    }
    Ok(())
}

proptest! {
    #[test]
    fn any_text_gives_a_map_or_an_error_with_a_line(text in any::<String>()) {
        sound(&text)?;
    }

    #[test]
    fn any_tokens_give_a_map_or_an_error_with_a_line(words in prop::collection::vec(prop::sample::select(vec![
        "MEMORY", "{", "}", "ASSERT", "(", ")", "a", "b", "=", "==", "<", "+", "-", "*", "/", "%", ",", ":", ";",
        "SECTIONS", "PROVIDE", "INCLUDE", "REGION_ALIAS", "?", "<<", "~", "+=", "#", "WEIGHTS",
        "ORIGIN", "LENGTH", "0", "1", "0xFFFFFFFFFFFFFFFF", "4K", "\"text\"", "/*", "*/", "\n", "!", ".",
    ]), 0..60)) {
        sound(&words.join(" "))?;
    }

    #[test]
    fn any_edited_map_gives_a_map_or_an_error_with_a_line(
        start in 0..MEMORY_X.len(),
        length in 0_usize..40,
        piece in "[ -~\n]{0,12}",
    ) {
        let end = (start + length).min(MEMORY_X.len());
        sound(&format!("{}{piece}{}", &MEMORY_X[..start], &MEMORY_X[end..]))?;
    }
}
