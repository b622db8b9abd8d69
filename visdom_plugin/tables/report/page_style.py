"""The page's style sheet, for light and dark screens."""

STYLE = """
:root{color-scheme:light dark;--ink:#1a1a1a;--soft:#666;--line:#ccc;--paper:#fff;--best:#c9f2c9;
--second:#d6eefa;--off:#f6f6f6}
@media (prefers-color-scheme:dark){
:root{--ink:#e6e6e6;--soft:#9a9a9a;--line:#444;--paper:#161616;--best:#1d4a26;--second:#173a4d;--off:#202020}}
body{margin:1.5rem auto;padding:0 1rem;max-width:75rem;background:var(--paper);color:var(--ink);
font:15px/1.45 system-ui,sans-serif}
h1{font-size:1.5rem} h2{font-size:1.1rem;margin:1.2rem 0 .4rem}
summary h2{display:inline-block;margin:.6rem 0;cursor:pointer}
.wide{overflow-x:auto;margin:1rem 0}
table{border-collapse:collapse;border-top:2px solid var(--ink);border-bottom:2px solid var(--ink);
font-variant-numeric:tabular-nums}
caption{text-align:left;white-space:nowrap;font-weight:600;padding:.3rem 0}
th,td{padding:.25rem .7rem;text-align:right;vertical-align:top;white-space:nowrap}
th:first-child{text-align:left} thead th{border-bottom:1px solid var(--ink)} th{font-weight:500}
tr.group th{font-style:italic;padding-top:.6rem;color:var(--soft)}
td.best{background:var(--best)} td.second{background:var(--second)}
td.partial,td.absent{background:var(--off);color:var(--soft)}
.spread,.beside{color:var(--soft);font-size:.85em}
pre{white-space:pre-wrap;background:var(--off);padding:.6rem;border-left:3px solid var(--line)}
figure{margin:1rem 0}
.side{display:flex;flex-wrap:wrap;align-items:flex-start;gap:0 2.5rem}
.side figure{flex:1 1 30rem} .side .wide{max-width:100%} .side caption{white-space:normal}
figcaption{font-weight:600;margin-bottom:.3rem}
svg.figure{width:100%;max-width:44rem;height:auto;display:block}
svg text{fill:var(--ink)}
.grid{stroke:var(--line)} .mean{stroke:var(--ink)}
.legend{display:flex;flex-wrap:wrap;gap:.2rem 1rem}
.strips{display:flex;flex-wrap:wrap;gap:.8rem 1.4rem}
.strip img{margin-right:2px;border:1px solid var(--line);vertical-align:top} .strip p{margin:.1rem 0;
font-size:.85em}
"""
