//! Style sheet of the page.

/// Light or dark, following the reader's system. Drawings keep a white background.
pub(super) const STYLE: &str = "\
:root { color-scheme: light dark; --ground: #fff; --ink: #1b1f24; --quiet: #57606a; --line: #d0d7de; --box: #f6f8fa; \
--link: #0550ae; --warn: #b35900; }
@media (prefers-color-scheme: dark) {
  :root { --ground: #14171c; --ink: #e6e8eb; --quiet: #9aa4b0; --line: #3a424c; --box: #1d2229; --link: #7db8ff; \
  --warn: #e69f00; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 64rem; padding: 1rem; background: var(--ground); color: var(--ink); font: 1rem/1.5 \
system-ui, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.6rem; line-height: 1.25; }
h2 { font-size: 1.3rem; line-height: 1.3; margin-top: 2.5rem; }
h3 { font-size: 1rem; margin: 1.5rem 0 0.25rem; }
a { color: var(--link); }
p, li, figcaption { max-width: 48rem; }
p, ul { margin: 0.25rem 0 0.75rem; }
ul { padding-left: 1.25rem; }
nav ul { list-style: none; padding: 0; }
nav h2 { margin-top: 1rem; }
small, header p, caption, figcaption { color: var(--quiet); }
main > section { border-top: 1px solid var(--line); }
.table { overflow-x: auto; margin: 0.75rem 0 1.25rem; }
table { border-collapse: collapse; font-size: 0.9rem; }
caption { text-align: left; padding-bottom: 0.25rem; }
th, td { border-bottom: 1px solid var(--line); padding: 0.3rem 0.75rem 0.3rem 0; text-align: left; vertical-align: \
top; min-width: 4rem; overflow-wrap: normal; }
thead th { background: var(--box); }
tbody th { font-weight: normal; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
thead .number { white-space: normal; }
figure { margin: 1rem 0 1.5rem; }
figure.pixels { display: inline-block; width: 48%; min-width: 17rem; vertical-align: top; }
figure.pixels img { width: 100%; image-rendering: pixelated; }
figure svg, figure img { display: block; max-width: 100%; height: auto; border-radius: 4px; background: #fff; }
.drawing { overflow-x: auto; }
.drawing svg { min-width: 34rem; }
figcaption { font-size: 0.9rem; margin-top: 0.35rem; }
.missing { border-left: 4px solid var(--warn); background: var(--box); padding: 0.1rem 1rem; margin: 1rem 0; }
.missing h3 { margin-top: 0.75rem; }
@media print { main > section { break-before: page; } .table { overflow: visible; } }
";
