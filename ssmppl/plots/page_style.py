"""The style sheet of the page: one column of text, cards side by side where there is room."""

__all__ = ["CSS"]

CSS = """
:root {
  color-scheme: light dark;
  --page: #fbfbf9; --card: #ffffff; --ink: #1d1f21; --soft: #5a6068; --line: #dcdcd6;
  --accent: #0072b2; --found: #e7f1f8; --open: #fbeee4; --quiet: #eef0ee;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #16181b; --card: #1f2226; --ink: #e8e8e6; --soft: #a8adb4; --line: #383c42;
    --accent: #6cb6e6; --found: #17303f; --open: #43301f; --quiet: #262a2e;
  }
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; text-size-adjust: 100%; }
body {
  margin: 0; background: var(--page); color: var(--ink); overflow-wrap: break-word;
  font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif;
}
main { max-width: 47rem; margin: 0 auto; padding: 1rem 1rem 3rem; }
h1 { font-size: 1.05rem; font-weight: 600; color: var(--soft); margin: 0.5rem 0 0.75rem; }
h2 { font-size: 1.3rem; line-height: 1.25; margin: 2.2rem 0 0.6rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 0.3rem; }
p { margin: 0.4rem 0; }
a { color: var(--accent); }
ul { margin: 0.4rem 0; padding-left: 1.2rem; }
li { margin: 0.35rem 0; }
.verdict { border-left: 0.35rem solid var(--accent); background: var(--found);
  padding: 0.7rem 1rem; border-radius: 0 0.5rem 0.5rem 0; }
.verdict p { font-size: 1.22rem; line-height: 1.42; margin: 0; font-weight: 500; }
.none-of-these { background: var(--open); border-color: #d55e00; }
.no-measurable-gap { background: var(--quiet); border-color: var(--soft); }
.cards { display: grid; gap: 0.8rem; margin-top: 0.9rem; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 0.5rem;
  padding: 0.75rem 1rem; min-width: 0; }
.card h2 { font-size: 0.92rem; color: var(--soft); margin: 0; font-weight: 600; }
.card .large { font-size: 1.3rem; line-height: 1.25; font-weight: 650; margin: 0.3rem 0 0.4rem; }
.card small { display: block; font-size: 0.92rem; font-weight: 500; color: var(--soft); }
.card p { font-size: 0.95rem; }
figure { margin: 0 0 1.6rem; }
figcaption { font-weight: 600; margin-bottom: 0.4rem; }
picture { display: block; background: #ffffff; border: 1px solid var(--line);
  border-radius: 0.5rem; padding: 0.5rem; }
img { display: block; width: 100%; height: auto; }
figure p, footer { color: var(--soft); font-size: 0.9rem; }
details { border-top: 1px solid var(--line); }
details:last-of-type { border-bottom: 1px solid var(--line); }
summary { cursor: pointer; padding: 0.65rem 0; font-weight: 500; }
.scroll { overflow-x: auto; margin-bottom: 0.8rem; }
table { width: max-content; border-collapse: collapse; font-size: 0.88rem;
  font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 0.9rem 0.3rem 0; text-align: right; vertical-align: top;
  white-space: nowrap; border-bottom: 1px solid var(--line); }
th { color: var(--soft); font-weight: 600; }
.left { text-align: left; }
td.left div { white-space: normal; width: max-content; max-width: 18rem; }
pre { margin: 0; padding: 0.8rem 1rem; background: var(--card); border: 1px solid var(--line);
  border-radius: 0.5rem; font: 0.82rem/1.5 ui-monospace, Menlo, Consolas, monospace;
  width: max-content; min-width: 100%; }
dt { font-weight: 600; }
dd { margin: 0 0 0.5rem; color: var(--soft); }
footer { margin-top: 2.5rem; border-top: 1px solid var(--line); padding-top: 0.6rem; }
@media (min-width: 46rem) {
  .cards { grid-template-columns: repeat(3, minmax(0, 1fr)); }
  main { padding-top: 2rem; }
}
@media (min-width: 64rem) {
  .cards { margin-left: -5rem; margin-right: -5rem; }
}
@media print {
  body { background: #ffffff; font-size: 10pt; }
  .cards { margin-left: 0; margin-right: 0; }
  figure, .card { break-inside: avoid; }
}
"""
