from __future__ import annotations

import os
import shutil
from contextlib import suppress
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import jsonschema_rs
import pytest

from app.governance import bundle
from app.governance.bundle_references import DIALECT
from app.governance.bundle_yaml import parse
from app.governance.decision import decide
from app.governance.errors import PolicyErrors
from app.governance.fitting import validator
from tests.governance.policy_world import POLICIES, context, files, proposal, shipped

GRASP, HUMAN, RELAXED, ORG, SITE, H = (
    "capabilities/grasp_object.yaml", "profiles/human-shared.yaml", "profiles/sim-relaxed.yaml", "organization.yaml",
    "site.yaml", "authority.yaml",
)  # fmt: skip

BROKEN = [
    ("unknown key", GRASP, "risk: medium", "risk: medium\nspeed: fast", "unknown key `speed`"),
    ("missing key", GRASP, "risk: medium\n", "", "`risk` is missing"),
    ("a time without end", GRASP, "timeout_s: 20", "timeout_s: 1.0e+308", "86400"),
    ("wrong type", GRASP, "timeout_s: 20", "timeout_s: soon", "timeout_s: expected a number, found `soon`"),
    ("a version that is a number", GRASP, "version: 1.0.0", "version: 1.0",
     "grasp_object.yaml:3: version: expected text, found `1.0`; valid: `1.0.0`"),
    ("a version of two numbers", GRASP, "version: 1.0.0", "version: v1.0",
     "version: `v1.0` is not made of three numbers, as in `1.0.0`"),
    ("no version", GRASP, "version: 1.0.0", "version:", "version: expected text, found nothing; valid: `1.0.0`"),
    ("a name of other letters", GRASP, "name: grasp_object", "name: Grasp-Object",
     "name: `Grasp-Object` is not made of small letters, digits and `_`, a letter first"),
    ("a yes", HUMAN, "shared_floor: true", "shared_floor: yes", "expected `true` or `false`, found `yes`"),
    ("a condition that is none", ORG, "when: place.forbidden", "when: true", "when: expected text, found `true`"),
    ("half a millisecond", HUMAN, "for_ms: 0", "for_ms: 0.5", "for_ms: expected a whole number, found `0.5`"),
    ("an alias", GRASP, "timeout_s: 20", "timeout_s: &a 20\nx: *a", "grasp_object.yaml:21: x: aliases are not allowed"),
    ("duplicate key", GRASP, "risk: medium", "risk: medium\nrisk: low", "stands twice"),
    ("not YAML", GRASP, "name: grasp_object", "name: [", "not readable as YAML"),
    ("not finite", HUMAN, "{max: 0.25,", "{max: .inf,", "not a finite number"),
    ("unit mismatch", GRASP, "unit: N,", "unit: m/s,",
     "unit mismatch: `force_n` is named in `N`, declared in `m/s`; valid: `unit: N`, `the name force_mps`"),
    ("a quantity whose name says no unit", GRASP, "force_n: {type: number,", "force: {type: number,",
     "unit mismatch: `force` is named in no unit, declared in `N`; valid: `the name force_n`"),
    ("limit of another unit", GRASP, "x-limit: grip_force_n", "x-limit: payload_kg", "unit mismatch"),
    ("bad schema", GRASP, "type: object", "type: thing", "not a valid JSON Schema"),
    ("open schema", GRASP, "additionalProperties: false", "additionalProperties: true", "closed object"),
    ("default out of range", GRASP, "default: 40", "default: 400",
     "default `400` is not valid for the parameter itself; valid: `2 to 140`"),
    ("default that is not of its list", GRASP, "x-ref: object", "x-ref: object, enum: [mug_1, box_1], default: glass_1",
     "default `glass_1` is not valid for the parameter itself; valid: `mug_1`, `box_1`"),
    ("default of another type", GRASP, "x-ref: object", "x-ref: object, default: 3",
     "default `3` is not valid for the parameter itself; valid: `a string`"),
    ("a listed value of another type", GRASP, "x-ref: object", "x-ref: object, enum: [mug_1, 3]",
     "grasp_object.yaml:10: inputs.properties.object_id.enum[1]: `3` is no string, so that no proposal could have it"),
    ("a value of another type", GRASP, "  properties:\n", "  properties:\n    n: {type: integer, const: 1.5}\n",
     "const: `1.5` is no integer"),
    ("a flag for a number", GRASP, "unit: N,", "unit: N, enum: [40, 20, 60, 80, 100, true],", "`True` is no"),
    ("a flag that is a number", GRASP, "  properties:\n", "  properties:\n    b: {type: boolean, enum: [1]}\n",
     "`1` is no boolean"),
    ("a bound that may not be proposed", GRASP, "unit: N,", "unit: N, enum: [40, 60, 80, 100, 120],",
     "set.force_n.max: `20` is no value that `force_n` of `grasp_object` may have, and would become its value"),
    ("a limit that may not be proposed", GRASP, "unit: N,", "unit: N, enum: [20, 40, 80, 100, 120],",
     "human-shared.yaml:14: limits.grip_force_n.max: `60` is no value that `force_n` of `grasp_object` may have"),
    ("a bound at an open end", GRASP, "unit: N, minimum: 2,", "unit: N, exclusiveMinimum: 20, minimum: 2,",
     "`20` is no value that `force_n`"),
    ("a bound between two steps", GRASP, "unit: N,", "unit: N, multipleOf: 8,", "`20` is no value that `force_n`"),
    ("inverted range", GRASP, "minimum: 2,", "minimum: 200,",
     "empty range: minimum `200` is not below maximum `140`; valid: `a minimum below 140`, `a maximum above 200`"),
    ("a manifest under another name", GRASP, "name: grasp_object", "name: seize_object", "stands in"),
    ("nobody's capability", GRASP, "permissions: [manipulation]", "permissions: []", "needs a permission"),
    ("parameter of no type", GRASP, "force_n: {type: number,", "force_n: {type: [number, 'null'],", "needs a type"),
    ("parameter of a deep type", GRASP, "force_n: {type: number,", "force_n: {type: array,", "needs a type"),
    ("parameter that is anything", GRASP, "  properties:\n", "  properties:\n    free: true\n", "needs a type"),
    ("no such unit", GRASP, "unit: N,", "unit: lbf,", "`lbf` is none"),
    ("no upper end", GRASP, "maximum: 140, ", "", "finite range"),
    ("neither name nor list", GRASP, ", x-ref: object", "", "neither a name of the site nor one of a list"),
    ("parameter no condition could name", GRASP, "  properties:\n", "  properties:\n    in: {type: boolean}\n",
     "not a usable name"),
    ("parameters by pattern", GRASP, "  properties:\n", "  patternProperties: {'^f': {type: number}}\n  properties:\n",
     "parameters have names"),
    ("two of a kind", GRASP, "  properties:\n", "  properties:\n    other: {type: string, x-ref: object}\n",
     "both refer to a kind of name, `object`: one may; valid: `target`, `surface`, "),
    ("an action without a tool", "capabilities/operate_tool.yaml", "x-ref: tool", "enum: [press]", "is its tool"),
    ("a reference to a file", GRASP, "force_n: {", "force_n: {$ref: 'file:///etc/hostname', ",
     "grasp_object.yaml:11: inputs.properties.force_n.$ref: `$ref` is `file:///etc/hostname`: it leads within this "
     "document, or nowhere; valid: `#/…`"),
    ("a reference to an address", GRASP, "force_n: {", "force_n: {$dynamicRef: 'http://127.0.0.1:9/', ",
     "`$dynamicRef` is `http://127.0.0.1:9/`"),
    ("a reference that is long", GRASP, "force_n: {", f"force_n: {{$ref: '{'a' * 100}', ", "`$ref` is `aaa"),
    ("a dialect to be fetched", GRASP, "  type: object", "  $schema: http://127.0.0.1:9/\n  type: object",
     "grasp_object.yaml:6: inputs.$schema: `http://127.0.0.1:9/` is no dialect that is read here; valid: `https:"),
    ("an origin of references", GRASP, "  type: object", "  $id: http://127.0.0.1:9/\n  type: object",
     "grasp_object.yaml:6: inputs.$id: `$id` is `http://127.0.0.1:9/`: references would lead there; valid: `inputs"),
    ("a reference to nothing", GRASP, "force_n: {", "force_n: {$ref: '#/properties/grip_n', ",
     "inputs.properties.force_n.$ref: `#/properties/grip_n` leads nowhere: there is no `grip_n`; valid: `object_id`, "),
    ("a reference to no branch", GRASP, "force_n: {", "force_n: {allOf: [{$ref: '#/properties/force_n/allOf/1'}], ",
     "leads nowhere: there is no `1`; valid: `0`"),
    ("a reference into a word", GRASP, "force_n: {", "force_n: {$ref: '#/type/a', ", "leads nowhere: there is no `a`"),
    ("a reference to itself", GRASP, "force_n: {", "force_n: {$ref: '#/properties/force_n', ",
     "grasp_object.yaml:11: inputs.properties.force_n.$ref: `#/properties/force_n` leads back to where it is"),
    ("a reference to the whole", GRASP, "force_n: {", "force_n: {$ref: '#', ", "`#` leads back to where it is"),
    ("a quantity below zero", GRASP, "minimum: 0.02", "minimum: -2.0", "from above only"),
    ("an integer with a unit", GRASP, "  properties:\n", "  properties:\n    n: {type: integer, unit: N, default: 1}\n",
     "`unit` belongs to a number, `n` is a integer; valid: `type: number`"),
    ("a flag with a limit", GRASP, "  properties:\n", "  properties:\n    b: {type: boolean, x-limit: wish}\n",
     "`x-limit` belongs to a number"),
    ("a name with a limit", GRASP, "x-ref: object", "x-ref: object, x-limit: payload_kg", "belongs to a number"),
    ("unknown reference", GRASP, "x-ref: object", "x-ref: wish", "kind of reference `wish`"),
    ("unknown condition", GRASP, "gripper_empty", "gripper_clean", "condition `gripper_clean`"),
    ("unknown permission", GRASP, "[manipulation]", "[juggling]", "permission `juggling`"),
    ("unknown rollback", GRASP, "rollback: release_and_retract", "rollback: none",
     "there is no recovery capability `none`; valid: `regrasp`, `release_and_retract`, `reposition_base`, `retrace`, "
     "`safe_retreat`, `null: it has none`"),
    ("a rollback that waits for a hand", GRASP, "rollback: release_and_retract", "rollback: takeover",
     "there is no recovery capability `takeover`; valid: `regrasp`"),
    ("a recovery that waits for a hand", HUMAN, "capability: reposition_base", "capability: takeover",
     "there is no recovery capability `takeover`; valid: `regrasp`"),
    ("uncovered profile", GRASP, "sim-relaxed: allowed, ", "", "`sim-relaxed` is not covered"),
    ("unknown profile", GRASP, "sim-relaxed: allowed", "sim-relaxed: allowed, moon: allowed", "profile `moon`"),
    ("no rollback where required", GRASP, "rollback: release_and_retract", "rollback: null", "rollback is required"),
    ("unknown variable", ORG, "when: place.forbidden", "when: plaze.forbidden", "unknown variable `plaze`"),
    ("unknown field", ORG, "when: place.forbidden", "when: place.forbiden", "no field `forbiden`"),
    ("bad CEL", ORG, "when: place.forbidden", "when: place. &&", "unexpected"),
    ("units compared", ORG, "target.mass_kg > limits.payload_kg", "target.mass_kg > limits.grip_force_n",
     "organization.yaml:34: rules[4].when: column 16: units differ: `kg` and `N` (for `grasp_object`); valid: "
     "`limits.payload_kg`, `a number in kg`"),
    ("a pure number added to a mass", ORG, "0.8 * limits.payload_kg", "0.8 + limits.payload_kg",
     "organization.yaml:40: rules[5].when: column 22: unit mismatch: a pure number and a quantity in `kg` do not"),
    ("a risk there is not", ORG, '"high", "critical"]', '"high", "crit"]',
     "`crit` is compared with what is never that (for `grasp_object`); valid: `critical`"),
    ("a mode there is not", ORG, "when: place.forbidden", "when: mode == 'slow'", "`slow` is compared"),
    ("a permission there is not, asked for", ORG, '"hazmat" in', '"hazmatt" in', "valid: `hazmat`"),
    ("unknown capability", ORG, "[operate_tool]", "[operate_tol]", "capability `operate_tol`"),
    ("unknown parameter", ORG, "{force_n: {max: 20}", "{farce_n: {max: 20}", "parameter `farce_n`"),
    ("empty bound", ORG, "{force_n: {max: 20}", "{force_n: {}", "empty bound"),
    ("inverted bound", ORG, "{force_n: {max: 20}", "{force_n: {max: 20, min: 30}",
     "inverted bound: min `30.0` is above max `20.0`; valid: `a min up to 20`, `a max from 30`"),
    ("unknown profile of a rule", ORG, "when: place.forbidden", "when: place.forbidden\n    profiles: [moon]",
     "profile `moon`"),
    ("modify without set", ORG, "    set: {force_n: {max: 20}, speed_mps: {max: 0.15}}\n", "",
     "could not modify anything; valid: `set`"),
    ("a bound and a value", HUMAN, "{to: place.corridor}", "{to: place.corridor, max: 3}",
     "without `min` and `max`; valid: `to`, `min and max`"),
    ("a bound on a name", HUMAN, "{to: place.corridor}", "{max: 3}", "is a string, it has no bounds"),
    ("a constant that names nothing", HUMAN, "{to: place.corridor}", "{to: \"'nope'\"}",
     "human-shared.yaml:34: rules[2].set.corridor.to: there is no corridor `nope`; valid: `aisle`"),
    ("a constant of one branch", HUMAN, "{to: place.corridor}", "{to: \"mode == 'careful' ? 'aisle' : 'ailse'\"}",
     "there is no corridor `ailse`; valid: `aisle`"),
    ("a value for a number", HUMAN, "clearance_m: {min: 0.3}", "clearance_m: {to: place.corridor}", "is a number"),
    ("a bound on what may be left out", ORG, "{force_n: {max: 20}, speed_mps: {max: 0.15}}", "{x_m: {max: 2}}",
     "give it a default to bound it; valid: `in its manifest a default for x_m`, `required: [x_m]`"),
    ("set without modify", ORG, "then: modify", "then: deny",
     "`set` belongs to a `modify` rule, this one says `deny`; valid: `then: modify`"),
    ("approvers without escalate", ORG, "then: escalate\n    approvers: 2", "then: deny\n    approvers: 2",
     "`approvers` belongs to an `escalate` rule; valid: `then: escalate`"),
    ("rule twice", ORG, "id: forbidden-zone", "id: hazardous",
     "organization.yaml:16: rules[1].id: rule `hazardous` stands twice, first on line 11; valid: `an id that no other "
     "rule of this file has`"),
    ("reserved agent", ORG, "planner:", "governance:", "`governance` is reserved; valid: `another name`"),
    ("reserved permission", ORG, "\npermissions: [navigation,", "\npermissions: [governance, navigation,",
     "`governance` is reserved; valid: `another name`"),
    ("granted and supervised", ORG, "tool_operation]}", "tool_operation], supervised: [navigation]}",
     "both granted and supervised; valid: `permissions`, `supervised`"),
    ("unknown supervised permission", ORG, "tool_operation]}", "tool_operation], supervised: [dancing]}",
     "permission `dancing`"),
    ("a profile under another name", HUMAN, "profile: human-shared", "profile: human-mixed", "stands in"),
    ("watch rule twice", HUMAN, "id: stall", "id: slip",
     "watch rule `slip` stands twice, first on line 101; valid: `an id "),
    ("watch rule for nobody", HUMAN, "    signal: stall_s\n", "    signal: stall_s\n    applies_to: [fly]\n",
     "capability `fly`"),
    ("separation out of nothing", RELAXED, "    below: 0.5\n    response: {enter: continue}",
     "    below: protective_separation_m\n    response: {enter: continue}",
     "declares no `separation` to compute it from; valid: `separation`, "),
    ("resuming what went on", RELAXED, "response: {enter: continue}", "response: {enter: continue, then: resume}",
     "only a pause can resume"),
    ("escalating to nobody", RELAXED, "response: {enter: continue}", "response: {enter: escalate}",
     "nobody could answer"),
    ("escalating to nobody, later", RELAXED, "response: {enter: continue}",
     "response: {enter: pause, persist_ms: 5000}", "nobody could answer"),
    ("asking nobody", RELAXED, "on: any\n    do: [", "on: any\n    do: [ask_human, ", "nobody could be asked"),
    ("no safer mode", HUMAN, "modes: [normal, careful]", "modes: [normal]", "needs the mode `careful`"),
    ("budget of another step", HUMAN, "budget: {retry: 1}", "budget: {rollback: 1, safer_mode: 1}",
     "`safer_mode` is no step"),
    ("more retries than the session has", HUMAN, "budget: {retry: 1}", "budget: {retry: 2}",
     "human-shared.yaml:188: recovery[12].budget.retry: a dead budget: `retry` is `2`, and `retry_budget` leaves a "
     "session `1` new attempts in all; valid: `up to 1`"),
    ("more careful attempts than the session has", HUMAN, "do: [safer_mode, ask_human]",
     "do: [safer_mode, ask_human]\n    budget: {safer_mode: 3}", "a dead budget: `safer_mode` is `3`"),
    ("fewer attempts in all than a row has", "profiles/real-restricted.yaml", "retry_budget: 2", "retry_budget: 1",
     "recovery[1].budget.retry: a dead budget: `retry` is `2`"),
    ("two rollbacks of one session", HUMAN, "budget: {retry: 1}", "budget: {retry: 1, rollback: 2}",
     "a dead budget: `rollback` is `2`, and a session is rolled back once; valid: `up to 1`"),
    ("a row for whatever comes, in the middle", HUMAN,
     "  - on: contact\n", "  - on: any\n    do: [retry]\n  - on: contact\n",
     "human-shared.yaml:195: recovery[15]: a dead row: the first row that matches holds, and `recovery[14]` (line 193) "
     "covers all of it; valid: `above recovery[14]`, `left out`"),
    ("a row that stands twice", HUMAN,
     "  - on: contact\n", "  - on: zone\n    do: [rollback, ask_human]\n  - on: contact\n",
     "human-shared.yaml:199: recovery[17]: a dead row: the first row that matches holds, and `recovery[14]` (line 193) "
     "covers all of it; valid: `left out`"),
    ("a row whose capabilities have theirs already", HUMAN, "  - on: object_lost\n    do: [",
     "  - on: object_lost\n    applies_to: [place_object, transport_object]\n    do: [retry]\n"
     "  - on: object_lost\n    do: [",
     "recovery[4]: a dead row: the first row that matches holds, and `recovery[2]` (line 156) and `recovery[3]` (line "
     "159) cover all of it; valid: `left out`"),
    ("the row for whatever comes, twice", HUMAN, "  - on: any\n", "  - on: any\n    do: [retry]\n  - on: any\n",
     "human-shared.yaml:208: recovery[21]: a dead row: the first row that matches holds, and `recovery[20]` (line 206) "
     "covers all of it; valid: `left out`"),
    ("a row for a risk that is covered", HUMAN, "  - on: contact\n    do: [ask_human]\n",
     "  - on: contact\n    risks: [low, medium]\n    do: [retry]\n  - on: contact\n    do: [ask_human]\n"
     "  - on: contact\n    risks: [high]\n    do: [ask_human]\n",
     "recovery[16]: a dead row: the first row that matches holds, and `recovery[15]` (line 196) covers all of it; "
     "valid: `above recovery[15]`, `left out`"),
    ("a row for a risk that its capability is not of", HUMAN, "  - on: contact\n",
     "  - on: contact\n    applies_to: [grasp_object]\n    risks: [low]\n    do: [retry]\n  - on: contact\n",
     "human-shared.yaml:195: recovery[14].risks: a dead row: no capability that it applies to is of such a risk; "
     "valid: `medium`"),
    ("steps behind the end", HUMAN, "do: [retry, terminate]", "do: [terminate, retry, retry]",
     "human-shared.yaml:169: recovery[5].do[1]: a dead step: `terminate` is always the last of its row, and `retry` "
     "stands behind it; valid: `do: [terminate]`"),
    ("a step behind a question", HUMAN, "do: [safer_mode, ask_human]", "do: [safer_mode, ask_human, terminate]",
     "do[2]: a dead step: `ask_human` is always the last of its row, and `terminate` stands behind it; valid: `do: "
     "[safer_mode, ask_human]`"),
    ("a step twice", HUMAN, "do: [retry, terminate]", "do: [retry, retry, terminate]",
     "human-shared.yaml:169: recovery[5].do[1]: a dead step: `retry` stands in this row before, and its budget is "
     "counted for both; valid: `retry once`"),
    ("a rollback twice, with a recovery in between", HUMAN, "do: [recovery_capability, safer_mode, ask_human]",
     "do: [rollback, recovery_capability, rollback]",
     "do[2]: a dead step: `rollback` stands in this row before, and its budget is counted for both; valid: "
     "`rollback once`"),
    ("a recovery twice, and a budget for one", HUMAN, "do: [recovery_capability, safer_mode, ask_human]",
     "do: [recovery_capability, recovery_capability]",
     "do[1]: a dead step: `recovery_capability` stands in this row before, and its budget is counted for both; valid: "
     "`recovery_capability once`, `budget: {recovery_capability: 2}`"),
    ("recovery for nobody", HUMAN, "applies_to: [transport_object]\n    do:", "applies_to: [fly]\n    do:",
     "capability `fly`"),
    ("approval nobody asks for", HUMAN, "modes: [approval-required, interrupt", "modes: [interrupt", "no mode of this"),
    ("approval required, and nobody asks", HUMAN, "modes: [approval-required, interrupt", "modes: [interrupt",
     "`grasp_object` requires approval here"),
    ("limited, and left out", GRASP, "default: 40, ", "",
     "may be left out: give it a default; valid: `in its manifest a default for force_n`, `required: [force_n]`"),
    ("unknown signal", HUMAN, "signal: stall_s", "signal: stall_h", "signal `stall_h`"),
    ("unknown failure", HUMAN, "failure: stall", "failure: boredom", "failure `boredom`"),
    ("unknown strategy", HUMAN, "do: [retry, terminate]", "do: [retry, pray]", "`pray` is not valid"),
    ("unknown threshold", HUMAN, "above: timeout_s", "above: bedtime", "`bedtime`"),
    ("threshold of another unit", HUMAN, "signal: stall_s\n    above: 5",
     "signal: stall_s\n    above: {limit: base_speed_mps}",
     "unit mismatch: `stall_s` is in `s`, `base_speed_mps` in `m/s`; valid: `a number in s`"),
    ("threshold of another unit, where a limit has it", HUMAN, "signal: stall_s\n    above: 5",
     "signal: grip_force_n\n    above: {limit: base_speed_mps}", "valid: `a limit in N: grip_force_n`, "),
    ("two thresholds", HUMAN, "above: 5\n", "above: 5\n    below: 3\n", "one threshold"),
    ("a reason that is read the other way round", HUMAN, "because: The base keeps", "because: \u202eThe base keeps",
     "human-shared.yaml:29: `U+202E` turns round how the line is read; valid: `text without it`"),
    ("a reason that is, once its escape is resolved", HUMAN, "because: The base keeps 0.3 m from everything.",
     'because: "\\U0000202eThe base keeps 0.3 m from everything."',
     "human-shared.yaml:29: `U+202E` turns round how the line is read"),
    ("a comment that is", HUMAN, "# computed every tick", "# \u2066computed every tick",
     "human-shared.yaml:52: `U+2066` turns round how the line is read"),
    ("a distance to be clear by for what stays", HUMAN, "response: {enter: escalate}",
     "response: {enter: escalate, clear_beyond: 1}", "response.clear_beyond: it does not clear by itself: "),
    ("a distance to be clear by of a sum", HUMAN, "    failure: overspeed\n    response: {enter: stop}",
     "    failure: overspeed\n    response: {enter: stop, clear_beyond: 0.1}",
     "response.clear_beyond: a sum falls by itself; only a threshold is cleared by a distance"),
    ("a distance that cannot be reached", HUMAN,
     "clear_after_ms: 500, then: resume, persist_ms: 3000, else: escalate}\n  - id: postcondition",
     "clear_after_ms: 500, clear_beyond: 0.5, then: resume}\n  - id: postcondition",
     "`implausible` would have to fall to 0 to be clear; valid: `less than 0.5`"),
    ("else without persist_ms", HUMAN, "persist_ms: 5000, ", "", "`else` follows"),
    ("recovery without capability", HUMAN, "    capability: safe_retreat\n", "", "needs `capability`"),
    ("uncovered failures", HUMAN, "on: any", "on: stall", "uncovered"),
    ("no approval", HUMAN, "  approval: {risk", "  # approval: {risk", "need `approval`"),
    ("approval by no risk", HUMAN, "{risk: [medium, high, critical],", "{risk: [],",
     "human-shared.yaml:211: authority.approval.risk: `approval-required` asks by risk, and no risk is named"),
    ("a shared floor watched for some", HUMAN, "    signal: separation_m\n",
     "    signal: separation_m\n    applies_to: [navigate_to]\n",
     "no watch rule holds `separation_m` of `grasp_object`, "),
    ("a shared floor watched from the wrong side", HUMAN, "    below: protective_separation_m ",
     "    above: protective_separation_m ",
     "shared_floor: people share the floor, and no watch rule holds `separation_m`"),
    ("no room", HUMAN, "{max: 60,", "{max: 1,",
     "limits.grip_force_n.max: `1.0` leaves `force_n` of `grasp_object` no room: its minimum is `2`; "
     "valid: `2 or more`"),
    ("a limit above what may be proposed", HUMAN, "{max: 60,", "{max: 500,",
     "human-shared.yaml:14: limits.grip_force_n.max: a dead limit: `500` is above `140`, the most any parameter it "
     "holds may be; valid: `up to 140`"),
    ("unknown sensor", HUMAN, "stale_after_ms: {arm", "stale_after_ms: {leg", "sensor `leg`"),
    ("a sensor that never counts as silent", HUMAN, "people: 400, ", "",
     "nothing says when `people` would count as silent; valid: `an age in milliseconds for each sensor`"),
    ("people who crawl", HUMAN, "human_speed_mps: 1.6", "human_speed_mps: 1.59",
     "separation.human_speed_mps: people who share the floor walk faster than 1.59 m/s (ISO 13855); "
     "valid: `1.6 or more`"),
    ("no list", HUMAN, "modes: [normal, careful]", "modes: normal", "expected a list, found `normal`"),
    ("no mapping", HUMAN, "motion: {base_deceleration_mps2: 1.0, base_radius_m: 0.45}", "motion: [1.0, 0.45]",
     "expected a mapping"),
    ("a long value", GRASP, "risk: medium", f"risk: medium\nrecovery: {'m' * 100}", "m…`"),
    ("unknown key of a list's item", HUMAN, "signal: stall_s", "signal: stall_s\n    loud: true", "unknown key `loud`"),
    ("empty site", SITE, "bounds_m: [0.0, 0.0, 8.0, 6.0]", "bounds_m: [8.0, 0.0, 0.0, 6.0]", "empty bounds"),
    ("flat site", SITE, "bounds_m: [0.0, 0.0, 8.0, 6.0]", "bounds_m: [0.0, 6.0, 8.0, 6.0]", "empty bounds"),
    ("unknown corridor", SITE, "corridor: aisle}", "corridor: alley}", "corridor `alley`"),
    ("area in view of nothing", SITE, "[2.3, 5.75], [0.9, 5.75]], target: bench_a_stand",
     "[2.3, 5.75], [0.9, 5.75]], target: mars", "target `mars`"),
    ("unknown start", SITE, "start: bench_a_stand", "start: mars", "target `mars`"),
    ("unknown surface", SITE, "surface: bench_a,", "surface: bench_z,", "surface `bench_z`"),
    ("clockwise zone", SITE, "[[4.6, 0.4], [6.2, 0.4], [6.2, 1.6], [4.6, 1.6]]",
     "[[4.6, 1.6], [6.2, 1.6], [6.2, 0.4], [4.6, 0.4]]",
     "a polygon runs counter-clockwise around some area; valid: `the same corners in the other order`"),
    ("flat zone", SITE, "[[4.6, 0.4], [6.2, 0.4], [6.2, 1.6], [4.6, 1.6]]", "[[4.6, 0.4], [6.2, 0.4], [5.0, 0.4]]",
     "around some area; valid: `corners that are not on one line`"),
    ("a zone whose edges cross", SITE, "[[4.6, 0.4], [6.2, 0.4], [6.2, 1.6], [4.6, 1.6]]",
     "[[4.6, 0.4], [6.2, 0.4], [5.0, 1.6], [6.2, 1.5]]",
     "zones.press_area.polygon: its edges cross, those from corners 2 and 4: nobody could tell what is inside; "
     "valid: `edges that meet at corners alone`"),
    ("a recovery that is forbidden", "capabilities/safe_retreat.yaml", "shared: guarded", "shared: forbidden",
     "human-shared.yaml:180: recovery[9].capability: `safe_retreat` is forbidden in this profile: the step could never "
     "be taken; valid: `regrasp`"),
    ("a rollback that is forbidden", "capabilities/safe_retreat.yaml", "shared: guarded", "shared: forbidden",
     "human-shared.yaml:8: rollback: `operate_tool` is rolled back by `safe_retreat`, which is forbidden in this "
     "profile; valid: `optional`"),
    ("confirmation of nothing", H, "confirm_before: []",
     "confirm_before: [{capability: dance, profile: human-shared, phases: [spin]}]", "capability `dance`"),
    ("confirmation of a phase there is not", H, "confirm_before: []",
     "confirm_before: [{capability: place_object, profile: human-shared, phases: [descend, relase]}]",
     "authority.yaml:9: confirm_before[0].phases[1]: there is no phase of `place_object` called `relase`; "
     "valid: `release`"),
    ("confirmation where nobody is asked", H, "confirm_before: []",
     "confirm_before: [{capability: place_object, profile: sim-relaxed, phases: [release]}]",
     "authority.yaml:9: confirm_before[0].profile: nobody is asked in `sim-relaxed`"),
    ("an undoing there is not", H, "confirm_before: []",
     "confirm_before: [{capability: inspect_area, profile: human-shared, phases: [look], on_deny: rollback}]",
     "authority.yaml:9: confirm_before[0].on_deny: `inspect_area` has no rollback; valid: `terminate`"),
    ("a default that is no denial's code", H, "default: unspecified", "default: unspecifed",
     "authority.yaml:17: denials.default: there is no code `unspecifed`; valid: `unspecified`"),
    ("a grant of critical risk", H, "risk: [medium, high]}", "risk: [medium, critical]}",
     "authority.yaml:13: grants.risk[1]"),
    ("a grant for an hour", H, "up_to_minutes: 15", "up_to_minutes: 60", "authority.yaml:13: grants.up_to_minutes"),
    ("a review without its mode", HUMAN, "  approval: {risk", "  review: {outcomes: [fault]}\n  approval: {risk",
     "human-shared.yaml:211: authority.review: no mode of this profile reviews what is finished"),
    ("a review of nothing", RELAXED, "{risk: [critical], outcomes: [terminated, stopped, taken_over, fault]}", "{}",
     "sim-relaxed.yaml:186: authority.review: neither a risk nor an outcome is named"),
    ("a tool that need not be named", "capabilities/operate_tool.yaml", "required: [tool, action]",
     "required: [action]", "operate_tool.yaml:10: inputs.properties.tool: `tool` names the tool, and may be left out"),
    ("a bound above what may be proposed", HUMAN, "clearance_m: {min: 0.3}", "clearance_m: {min: 5}",
     "human-shared.yaml:28: rules[1].set.clearance_m.min: min `5` is above the maximum `1` of `clearance_m` of "
     "`navigate_to`; valid: `0.1 to 1`"),
    ("a bound below what may be proposed", HUMAN, "set: {force_n: {max: 20}", "set: {force_n: {max: 1}",
     "rules[0].set.force_n.max: max `1` is below the minimum `2` of `force_n` of `grasp_object`"),
    ("a target in a forbidden zone", SITE, "dock: {x_m: 0.8, y_m: 0.8", "dock: {x_m: 5.0, y_m: 1.0",
     "site.yaml:8: targets.dock: target `dock` lies in the forbidden zone `press_area`"),
    ("a target outside the site", SITE, "dock: {x_m: 0.8, y_m: 0.8", "dock: {x_m: 50, y_m: 0.8",
     "site.yaml:8: targets.dock: `dock` lies at (50, 0.8), outside the site; valid: `x_m from 0 to 8`"),
    ("an object beside its surface", SITE, "surface: bench_a, x_m: 1.45,", "surface: bench_a, x_m: 7.0,",
     "site.yaml:33: objects.mug_1: `mug_1` lies at (7, 5.25), which is not on `bench_a`; valid: `within 0.7 m along "
     "and 0.35 m across of (1.6, 5.4), turned by 0 rad`"),
    ("an object beside its surface when that is turned", SITE, "half_y_m: 0.35, yaw_rad: 0.0, target: bench_a_stand",
     "half_y_m: 0.1, yaw_rad: 1.5708, target: bench_a_stand", "site.yaml:33: objects.mug_1: `mug_1` lies at"),
    ("two objects at one point", SITE, "surface: bench_a, x_m: 1.75,", "surface: bench_a, x_m: 1.45,",
     "site.yaml:34: objects.glass_1: `glass_1` lies at (1.45, 5.25), where `mug_1` lies already; "
     "valid: `another point`"),
    ("a threshold that is a list", HUMAN, "above: 5\n", "above: [5]\n",
     "watch[11].above: expected a number, a name, or a mapping of `limit`, `times`; found `[5]`"),
    ("an object outside the site", SITE, "x_m: 7.35, y_m: 2.8}", "x_m: 7.35, y_m: 6.8}", "`solvent_1` lies at"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "old", "new", "said"), [row[1:] for row in BROKEN], ids=[row[0] for row in BROKEN])
def test_says_what_is_wrong_with_a_broken_directory(file, old, new, said):
    problems = wrong_with(file, old, new)
    told = [problem for problem in problems if said in str(problem)]
    assert told, list(map(str, problems))
    assert all(problem.line > 0 for problem in told)


@cache
def wrong_with(file, old, new):
    """Return what is wrong with the shipped directory once one of its files has been changed."""
    text = files()
    assert old in text[file]
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files({**text, file: text[file].replace(old, new)})
    return caught.value.problems


ALIVE = {
    "one capability, then all": (
        "  - on: contact\n", "  - on: contact\n    applies_to: [grasp_object]\n    do: [retry]\n  - on: contact\n"
    ),
    "one risk, then all": (
        "  - on: contact\n", "  - on: contact\n    risks: [low]\n    do: [retry]\n  - on: contact\n"
    ),
    "whatever comes to one, then one that comes to all": (
        "  - on: contact\n", "  - on: any\n    applies_to: [operate_tool]\n    do: [retry]\n  - on: contact\n"
    ),
    "the last failure by name, then whatever comes": (
        "  - on: any\n", "  - on: retries_exhausted\n    do: [terminate]\n  - on: any\n"
    ),
    "two risks of two capabilities": (
        "  - on: contact\n",
        "  - on: contact\n    applies_to: [navigate_to]\n    risks: [low]\n    do: [retry]\n"
        "  - on: contact\n    applies_to: [navigate_to, grasp_object]\n    do: [retry]\n  - on: contact\n",
    ),
    "an attempt that was passed over": (
        "do: [recovery_capability, safer_mode, ask_human]", "do: [safer_mode, recovery_capability, safer_mode]"
    ),
    "a recovery with budget for two": (
        "do: [recovery_capability, safer_mode, ask_human]",
        "do: [recovery_capability, recovery_capability]\n    budget: {recovery_capability: 2}",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new"), ALIVE.values(), ids=ALIVE)
def test_takes_no_row_or_step_for_dead_that_may_be_taken(old, new):
    text = files()
    assert old in text[HUMAN]
    bundle.load_files({**text, HUMAN: text[HUMAN].replace(old, new)})


def test_what_cannot_be_read_of_a_capability_makes_no_row_dead():
    text = files()
    text[GRASP] = text[GRASP].replace("risk: medium", "risk: enormous")
    row = "  - on: contact\n    applies_to: [grasp_object]\n    risks: [low]\n    do: [retry]\n  - on: contact\n"
    text[HUMAN] = text[HUMAN].replace("  - on: contact\n", row)
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files(text)
    assert {problem.file for problem in caught.value.problems} == {GRASP}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("force_n: {type: number,", "force_n: {type: numbr,", "`numbr` is no type; valid: `number`"),
        (
            "force_n: {type: number, unit: N, minimum: 2",
            "force_n: {type: number, unit: N, minimum: two",
            '"two" is not',
        ),
    ],
)
def test_a_fault_inside_a_schema_is_told_with_its_own_line(old, new, said):
    text = files()[GRASP]
    line = next(number for number, words in enumerate(text.splitlines(), 1) if old in words)
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files({**files(), GRASP: text.replace(old, new)})
    assert said in str(caught.value)
    assert [problem.line for problem in caught.value.problems] == [line]


@pytest.mark.parametrize(
    ("above", "said"),
    [
        ("{limit: contact_force}", ["watch[11].above.limit: `contact_force` is not valid; valid: `tcp_speed_mps`, "]),
        ("{limit: 3, times: 0}", ["watch[11].above.limit: `3` is not valid; ", "watch[11].above.times: `0`: input sh"]),
        ("{times: 1}", ["watch[11].above.limit: key `limit` is missing"]),
        ("true", ["watch[11].above: expected a number, a name, or a mapping of `limit`, `times`; found `True`"]),
    ],
)
def test_what_is_wrong_with_a_threshold_is_told_once(above, said):
    text = {**files(), HUMAN: files()[HUMAN].replace("above: 5\n", f"above: {above}\n", 1)}
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files(text)
    told = [str(problem).partition(": ")[2] for problem in caught.value.problems]
    assert len(told) == len(said)
    assert all(line.startswith(words) for line, words in zip(told, said, strict=True)), told


def test_a_threshold_that_fits_nothing_hides_no_fault_beside_it():
    text = {**files(), SITE: files()[SITE].replace("{pull_down: down, push_up: up}", "{float: {a: 1}, str: {a: 1}}")}
    text[HUMAN] = text[HUMAN].replace("above: 5\n", "above: [5]\n    for_ms: soon\n", 1)
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files(text)
    assert [problem.key.rpartition(".")[2] for problem in caught.value.problems] == [
        "above",
        "for_ms",
        *["actions"] * 2,
    ]


def test_reports_all_problems_together_in_order():
    text = files()
    text[GRASP] = text[GRASP].replace("risk: medium", "risk: enormous")
    text[SITE] = text[SITE].replace("fragile: true", "fragile: maybe")
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files(text)
    assert [problem.file for problem in caught.value.problems] == [GRASP, SITE]


STRANGERS = [
    ("target.name == 'mug_9'", 13, "mug_9", '`mug_1`, `box_1`, `driver_1`, `glass_1`, `solvent_1`, `""`'),
    ("target.name in ['mug_1', 'mug_9']", 13, "mug_9", "`mug_1`, "),
    ("!(target.name != 'mug_9')", 15, "mug_9", "`mug_1`, "),
    ("target.kind == 'moon'", 13, "moon", "`none`, "),
    ("place.name == 'dock' || place.name == 'moon'", 36, "moon", "`bench_a`, `bench_a_stand`, "),
    ("place.kind == 'moon'", 12, "moon", "`tool`, `none`, "),
    ("has(place.corridor) && place.corridor == 'moon'", 39, "moon", "`aisle`"),
    ("tool.name == 'moon'", 11, "moon", "`lever`, `press`"),
    ("tool.kind == 'moon'", 11, "moon", "`button`, `lever`"),
    ("has(world.holding) && world.holding == 'mug_9'", 37, "mug_9", "`mug_1`, "),
    ("capability.name == 'grasp_objekt'", 17, "grasp_objekt", "`grasp_object`, "),
    ("profile.name == 'human-sharde'", 14, "human-sharde", "`human-shared`, "),
    ("params.tool == 'moon'", 13, "moon", "`lever`, `press`"),
    ("params.action == 'moon'", 15, "moon", "`press`, "),
]  # fmt: skip


@pytest.mark.parametrize(("when", "column", "stranger", "valid"), STRANGERS, ids=[row[0] for row in STRANGERS])
def test_a_condition_names_nothing_that_does_not_exist(when, column, stranger, valid):
    (said,) = told_of(when)
    assert said.startswith(
        f"organization.yaml:50: rules[7].when: column {column}: `{stranger}` is compared with what is never that "
        f"(for `operate_tool`); valid: {valid}"
    )


def told_of(when, **others):
    """Return what is wrong with a condition about a tool, other files exchanged."""
    text = {**files(), **others}
    text[ORG] = text[ORG].replace("when: tool.press && profile.shared_floor", f'when: "{when}"')
    try:
        bundle.load_files(text)
    except PolicyErrors as errors:
        return [str(problem) for problem in errors.problems if problem.file == ORG]
    return []


NAMED = [
    "target.name == ''", "target.kind != 'none'", "target.name == 'box_1' && target.kind == 'box'", "place.name == ''",
    "place.name in ['dock', 'shelf', 'shelf_front', 'press', 'mug_1']", "place.kind in ['point', 'none', 'object']",
    "agent.name == 'somebody'", "has(metadata.intent) && metadata.intent == 'moon'", "target.name.startsWith('mug_')",
    "capability.name in ['safe_retreat', 'operate_tool'] && profile.name != 'sim-relaxed'",
    "'governance' in agent.permissions", "has(world.holding) && world.holding == target.name",
]  # fmt: skip


@pytest.mark.parametrize("when", NAMED)
def test_a_condition_may_name_what_exists_nothing_and_anybody(when):
    assert told_of(when) == []


UNREAD = [
    ("target.name == 'mug_9' && place.corridor == 'moon' && params.tool == 'moon' && tool.kind == 'moon'",
     {SITE: "site: ["}),
    ("capability.name == 'inspect_area'", {"capabilities/inspect_area.yaml": "name: ["}),
    ("capability.name == 'probe_it'", {"capabilities/probe_it.yaml": "name: ["}),
    ("profile.name == 'night-shift'", {"profiles/night-shift.yaml": "profile: ["}),
]  # fmt: skip


@pytest.mark.parametrize(("when", "unread"), UNREAD, ids=[row[0] for row in UNREAD])
def test_a_condition_may_name_what_a_file_that_cannot_be_read_may_declare(when, unread):
    assert told_of(when, **unread) == []


@pytest.mark.parametrize(
    ("spec", "key"),
    [
        ("x-ref: object, enum: [mug_1, mug_9]", "enum[1]: there is no object `mug_9`; valid: `mug_1`"),
        ("x-ref: object, default: mug_9", "default: there is no object `mug_9`; valid: `mug_1`"),
        ("x-ref: object, const: mug_9", "const: there is no object `mug_9`; valid: `mug_1`"),
    ],
)
def test_what_a_schema_gives_a_name_exists(spec, key):
    text = files()
    text[GRASP] = text[GRASP].replace("x-ref: object", spec)
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files(text)
    assert f"{GRASP}:10: inputs.properties.object_id.{key}" in str(caught.value)
    assert told({**text, SITE: "site: ["}) == told({**files(), SITE: "site: ["})


def test_a_condition_may_name_those_of_its_list_alone():
    text = files()
    text[GRASP] = text[GRASP].replace("x-ref: object", "x-ref: object, enum: [mug_1]")
    text[ORG] = text[ORG].replace("[grasp_object, transport_object, regrasp]", "[grasp_object]", 1)
    text[ORG] = text[ORG].replace("when: target.mass_kg >", "when: params.object_id == 'box_1' || target.mass_kg >")
    with pytest.raises(PolicyErrors, match=r"column 18: `box_1` is compared .*; valid: `mug_1`"):
        bundle.load_files(text)


ACCEPTED_ONCE = "capability.name != 'moon' && profile.name != 'moon' && target.name != 'moon' && place.kind != 'moon'"


def test_a_version_that_decided_once_decides_though_it_lists_what_no_proposal_could_have():
    text = files()
    text[GRASP] = text[GRASP].replace("x-ref: object", "x-ref: object, enum: [mug_1, 3, [box_1]]")
    with pytest.raises(PolicyErrors, match="`3` is no string"):
        bundle.load_files(text)
    assert bundle.load_kept(text).gates


def test_a_version_that_decided_once_decides_as_it_did_though_it_names_what_does_not_exist():
    text = files()
    text[ORG] = text[ORG].replace("when: tool.press && profile.shared_floor", f'when: "{ACCEPTED_ONCE}"')
    with pytest.raises(PolicyErrors, match="`moon` is compared with what is never that"):
        bundle.load_files(text)
    kept = bundle.load_kept(text)
    assert kept.digest == bundle.digest(text)
    asked = proposal("operate_tool", tool="lever", action="push_up")
    found = decide(kept, asked, context("real-restricted", stand="tool_stand"))
    assert "organization/press-two-approvers" in [reason.rule for reason in found.verdict.reasons]
    assert bundle.load_kept(files()).gates.keys() == shipped().gates.keys()


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        (ORG, "when: place.forbidden", "when: place.forbiden"),
        (ORG, "[operate_tool]", "[operate_tol]"),
        (GRASP, "sim-relaxed: allowed, ", ""),
        (GRASP, "risk: medium", "risk: enormous"),
        (GRASP, "force_n: {type: number,", "force_n: {type: numbr,"),
    ],
)
def test_what_cannot_be_compiled_never_decided_and_says_why(file, old, new):
    text = {**files(), file: files()[file].replace(old, new)}
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_kept(text)
    assert {told_as(problem) for problem in caught.value.problems} == told(text)


def told(text):
    try:
        bundle.load_files(text)
    except PolicyErrors as errors:
        return {told_as(problem) for problem in errors.problems}
    return set()


def told_as(problem):
    """Return what is wrong, but for the names that would be valid: a file that cannot be read lends its own."""
    return problem.file, problem.line, problem.key, problem.message


def test_every_name_is_known_of_what_can_be_typed():
    known = bundle.know(bundle.read_shapes(files()))
    assert known.named == set(shipped().capabilities)
    assert known.profiles == set(shipped().profiles)
    text = {**files(), GRASP: files()[GRASP].replace("force_n: {type: number,", "force_n: {type: numbr,")}
    with pytest.raises(PolicyErrors, match="numbr"):
        bundle.know(bundle.read_shapes(text))


def test_without_the_permissions_there_are_only_what_does_not_fit_is_told():
    text = files()
    text[ORG] = text[ORG].replace("permissions:", "permits:", 1)
    text[HUMAN] = text[HUMAN].replace("signal: stall_s", "signal: boredom")
    assert {file for file, *_ in told(text)} == {ORG}


@pytest.mark.parametrize("name", ["organization.yaml", "authority.yaml", "site.yaml"])
def test_a_missing_file_is_named(name):
    text = files()
    del text[name]
    with pytest.raises(PolicyErrors, match=name):
        bundle.load_files(text)


@pytest.mark.parametrize("folder", ["capabilities", "profiles"])
def test_an_empty_folder_is_named(folder):
    text = {name: value for name, value in files().items() if not name.startswith(f"{folder}/")}
    with pytest.raises(PolicyErrors, match=f"{folder}.*has no files"):
        bundle.load_files(text)


def test_an_unknown_key_is_answered_with_the_keys_there_are():
    text = files()
    text[HUMAN] = text[HUMAN].replace("signal: stall_s", "signal: stall_s\n    loud: true")
    text[HUMAN] = text[HUMAN].replace("above: timeout_s", "above: {limit: contact_force_n, times: 1.0, off: 1}")
    text[HUMAN] = text[HUMAN].replace("approvers: {default: 1,", "approvers: {none: 1, default: 1,")
    dock = "x_m: 0.8, y_m: 0.8, yaw_rad: 0.0, z_m: 1.0"
    text[SITE] = text[SITE].replace("x_m: 0.8, y_m: 0.8, yaw_rad: 0.0}", f"{dock}}}\n  x_m: {{{dock}}}")
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files(text)
    valid = {problem.key: problem.valid for problem in caught.value.problems}
    assert {"signal", "response", "for_ms"} <= set(valid["watch[11].loud"])
    assert set(valid["authority.approval.approvers.none"]) == {"default", "low", "medium", "high", "critical"}
    assert set(valid["watch[12].above.off"]) == {"limit", "times"}
    assert set(valid["targets.x_m.z_m"]) == set(valid["targets.dock.z_m"])
    assert set(valid["targets.dock.z_m"]) == {"x_m", "y_m", "yaw_rad", "corridor"}


@pytest.mark.parametrize("name", ["organization", "authority", "guard", "admission"])
def test_a_profile_may_not_go_by_the_name_of_another_origin_of_rules(name):
    text = files()
    text[f"profiles/{name}.yaml"] = text[RELAXED].replace("profile: sim-relaxed", f"profile: {name}")
    with pytest.raises(PolicyErrors, match=f"`{name}` is reserved"):
        bundle.load_files(text)


def test_a_capability_forbidden_in_a_profile_has_no_gate_there():
    text = files()
    text[GRASP] = text[GRASP].replace("sim-relaxed: allowed", "sim-relaxed: forbidden")
    policy = bundle.load_files(text)
    assert ("grasp_object", "sim-relaxed") not in policy.gates
    assert ("grasp_object", "test-audit") in policy.gates


@pytest.mark.parametrize(("value", "good"), [("left", True), ("light", False)])
def test_a_rule_sets_a_value_of_the_list(value, good):
    text = files()
    name = "capabilities/navigate_to.yaml"
    hand = "  properties:\n    hand: {type: string, enum: [left, right], default: right}\n"
    rule = f"""
  - {{id: way, applies_to: [navigate_to], then: modify, set: {{hand: {{to: '"{value}"'}}}}, because: So.}}
"""
    changed = {name: text[name].replace("  properties:\n", hand, 1), ORG: text[ORG] + rule}
    if good:
        assert "organization/way" in bundle.load_files({**text, **changed}).rules
        return
    with pytest.raises(PolicyErrors, match="no value of `hand` called `light`; valid: `right`, `left`"):
        bundle.load_files({**text, **changed})


def test_a_constant_that_names_nothing_is_told_once_for_all_its_capabilities():
    text = files()
    with pytest.raises(PolicyErrors) as caught:
        bundle.load_files({**text, HUMAN: text[HUMAN].replace("{to: place.corridor}", "{to: \"'nope'\"}")})
    assert len(caught.value.problems) == 1


def test_a_floor_people_share_is_watched_for_them():
    text = files()
    unwatched = text[RELAXED].replace(
        "    signal: separation_m\n    below: 0.5\n", "    signal: stall_s\n    above: 5\n"
    )
    assert unwatched != text[RELAXED]
    assert not bundle.load_files({**text, RELAXED: unwatched}).profiles["sim-relaxed"].shared_floor
    shared = unwatched.replace("shared_floor: false", "shared_floor: true")
    said = "sim-relaxed.yaml:6: shared_floor: people share the floor, and no watch rule holds `separation_m` from below"
    with pytest.raises(PolicyErrors, match=said):
        bundle.load_files({**text, RELAXED: shared})


def test_a_limit_may_be_as_high_as_what_it_holds():
    text = files()
    policy = bundle.load_files(
        {**text, HUMAN: text[HUMAN].replace("grip_force_n: {max: 60,", "grip_force_n: {max: 140,")}
    )
    assert policy.profiles["human-shared"].limits["grip_force_n"].maximum == 140


def test_parameters_may_be_counted_chosen_from_a_list_or_switched():
    text = files()
    more = "  properties:\n    tries: {type: integer, minimum: 1, maximum: 3, default: 1}\n"
    more += "    hand: {type: string, enum: [left, right], default: left}\n    soft: {type: boolean, default: false}\n"
    text[GRASP] = text[GRASP].replace("  properties:\n", more)
    policy = bundle.load_files(text)
    assert policy.validate_params("grasp_object", {"object_id": "mug_1"}) == {
        "object_id": "mug_1", "tries": 1, "hand": "left", "soft": False, "force_n": 40.0, "speed_mps": 0.3,
    }  # fmt: skip
    for wrong in ({"tries": 4}, {"tries": 1.5}, {"hand": "third"}, {"soft": 1}):
        assert isinstance(policy.validate_params("grasp_object", {"object_id": "mug_1", **wrong}), tuple)


def test_an_integer_is_one_however_it_is_written():
    text = files()
    text[GRASP] = text[GRASP].replace("  properties:\n", "  properties:\n    tries: {type: integer, default: 2.0}\n")
    policy = bundle.load_files(text)
    for given, whole in (({}, 2), ({"tries": 3.0}, 3), ({"tries": 1e17}, 10**17)):
        filled = policy.validate_params("grasp_object", {"object_id": "mug_1", **given})
        assert (filled["tries"], type(filled["tries"])) == (whole, int)
    for huge in (2**63, 1e30, -1e300):
        (problem,) = policy.validate_params("grasp_object", {"object_id": "mug_1", "tries": huge})
        assert (problem.param, problem.code) == ("tries", "out_of_range")


FORCE = "    force_n: {type: number,"
REFERRING = [
    ("to what is beside it", "#/$defs/gentle", "gentle: {maximum: 50}", None),
    ("and is as strict as that is", "#/$defs/gentle", "gentle: {maximum: 30}", "default `40` is not valid for"),
    ("with what pointers escape", "#/$defs/a~1b%20c", "a/b c: {minimum: 2}", None),
    ("to one of a list", "#/$defs/some/allOf/1", "some: {allOf: [false, true]}", None),
    ("to what twice is the next", "#/$defs/a0", ", ".join(
        f"a{n}: {{allOf: [{{$ref: '#/$defs/a{n + 1}'}}, {{$ref: '#/$defs/a{n + 1}'}}]}}" for n in range(20)
    ) + ", a20: true", "has more than 10,000 parts"),
    ("to what leads on and on", "#/$defs/a0", ", ".join(
        f"a{n}: {{$ref: '#/$defs/a{n + 1}'}}" for n in range(20_000)
    ) + ", a20000: {}", "nests deeper than 100 levels"),
    ("in a circle", "#/$defs/a", "a: {$ref: '#/$defs/b'}, b: {allOf: [{$ref: '#/$defs/a'}]}", "leads back to where"),
]  # fmt: skip


@pytest.mark.parametrize(("to", "beside", "said"), [row[1:] for row in REFERRING], ids=[row[0] for row in REFERRING])
def test_an_input_may_refer(to, beside, said):
    text = files()
    text[GRASP] = text[GRASP].replace(FORCE, f"    force_n: {{$ref: '{to}', type: number,")
    text[GRASP] = text[GRASP].replace("  properties:\n", f"  $defs: {{{beside}}}\n  properties:\n")
    if said is not None:
        with pytest.raises(PolicyErrors, match=said) as caught:
            bundle.load_files(text)
        assert {(problem.file, problem.line > 1) for problem in caught.value.problems} == {(GRASP, True)}
        return
    policy = bundle.load_files(text)
    assert isinstance(policy.validate_params("grasp_object", {"object_id": "mug_1", "force_n": 1}), tuple)
    assert isinstance(policy.validate_params("grasp_object", {"object_id": "mug_1", "force_n": 40}), dict)


@pytest.mark.parametrize(
    ("also", "default"),
    [("exclusiveMaximum: 15", 5), ("enum: [5, 15]", 5), ("const: 5", 5), ("multipleOf: 20, exclusiveMinimum: 0", 40)],
)
def test_a_bound_that_nothing_proposed_lies_beyond_may_be_any(also, default):
    text = files()
    text[GRASP] = text[GRASP].replace("unit: N,", f"unit: N, {also},").replace("default: 40", f"default: {default}")
    assert bundle.load_files(text)


def test_an_input_may_name_the_dialect_it_is_written_in():
    text = files()
    text[GRASP] = text[GRASP].replace("  properties:\n", f"  $schema: {DIALECT}\n  properties:\n")
    assert bundle.load_files(text).capabilities["grasp_object"].inputs["$schema"] == DIALECT


@pytest.fixture
def asked():
    """Serve a JSON Schema that refuses nothing, and list the paths that were asked for."""
    paths = []

    class Anything(BaseHTTPRequestHandler):
        def do_GET(self):
            paths.append(self.path)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"{}")

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Anything) as server:
        thread = Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/", paths
        server.shutdown()
        thread.join()


LEADING_OUT = ["{$ref: 'URLa'}", "{$dynamicRef: 'URLa'}", "{$schema: 'URLa'}", "{$id: 'URL', $ref: b}",
               "{properties: {a: {$schema: 'URLa'}}}", "{default: {$ref: 'URLa'}, $ref: '#/default'}"]  # fmt: skip


@pytest.mark.parametrize("schema", LEADING_OUT)
def test_loading_asks_nobody_for_what_a_policy_refers_to(asked, schema):
    url, paths = asked
    found = schema.replace("URL", url)
    text = files()
    text[GRASP] = text[GRASP].replace("  properties:\n", f"  allOf: [{found}]\n  properties:\n")
    with pytest.raises(PolicyErrors, match=url):
        bundle.load_files(text)
    assert paths == []


@pytest.mark.parametrize("schema", LEADING_OUT)
def test_what_validates_inputs_could_not_ask_either(asked, tmp_path, schema):
    url, paths = asked
    (tmp_path / "a").write_text("{}")
    (tmp_path / "b").write_text("{}")
    for base in (url, f"{tmp_path.as_uri()}/"):
        document, _ = parse("any.yaml", schema.replace("URL", base))
        with suppress(ValueError, jsonschema_rs.ValidationError):
            validator(document.value).is_valid({"a": 1})
    assert paths == []
    with pytest.raises((ValueError, jsonschema_rs.ValidationError)):
        validator({"$ref": f"{tmp_path.as_uri()}/a"})


def test_a_file_nothing_would_read_is_an_error():
    with pytest.raises(PolicyErrors, match="nothing would read it"):
        bundle.load_files({**files(), "profile/typo.yaml": "{}"})


@pytest.mark.parametrize(
    "name", ["profiles//human-shared.yaml", "./profiles/human-shared.yaml", "profiles/./human-shared.yaml"]
)
def test_one_file_is_not_brought_twice_by_two_ways_to_write_its_name(name):
    other = files()["profiles/human-shared.yaml"].replace("grip_force_n: {max: 60", "grip_force_n: {max: 30")
    with pytest.raises(PolicyErrors, match="nothing would read it"):
        bundle.load_files({**files(), name: other})


def test_a_file_whose_suffix_is_in_capitals_is_not_passed_over(tmp_path):
    shutil.copytree(POLICIES, tmp_path, dirs_exist_ok=True)
    (tmp_path / "profiles" / "Extra.YAML").write_text("{}")
    with pytest.raises(PolicyErrors, match="nothing would read it"):
        bundle.load(tmp_path)


@pytest.mark.parametrize(("folder", "read"), [("profiles", bundle.read_files), ("tests", bundle.read_cases)])
def test_a_file_whose_name_is_no_utf_8_is_named_as_far_as_it_can_be(tmp_path, folder, read):
    (tmp_path / folder).mkdir()
    (tmp_path / folder / os.fsdecode(b"caf\xe9.yaml")).write_text("{}")
    with pytest.raises(PolicyErrors) as raised:
        read(tmp_path)
    (problem,) = raised.value.problems
    assert problem.file == rf"{folder}/caf\udce9.yaml"
    assert "no UTF-8" in problem.message


def test_a_directory_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(PolicyErrors, match="no such directory"):
        bundle.load(tmp_path / "nowhere")


def test_a_file_that_is_no_text_is_an_error(tmp_path):
    (tmp_path / "site.yaml").write_bytes("site: café\n# two\nstart: ".encode() + b"\xff\xfe\x00\n")
    with pytest.raises(PolicyErrors, match=r"site\.yaml:3: cannot be read as UTF-8 text"):
        bundle.load(tmp_path)


def test_what_is_named_as_a_policy_file_and_cannot_be_read_is_an_error_and_no_file_less(tmp_path):
    shutil.copytree(POLICIES, tmp_path, dirs_exist_ok=True)
    (tmp_path / "profiles" / ".#new.yaml").symlink_to(tmp_path / "nowhere")  # as editors lock what they change
    assert bundle.load(tmp_path).digest == shipped().digest
    (tmp_path / "profiles" / "gone.yaml").symlink_to(tmp_path / "nowhere")
    (tmp_path / "capabilities" / "folder.yaml").mkdir()
    with pytest.raises(PolicyErrors) as found:
        bundle.load(tmp_path)
    assert [problem.file for problem in found.value.problems] == ["capabilities/folder.yaml", "profiles/gone.yaml"]


@pytest.mark.timeout(20)
@pytest.mark.parametrize("what", ["a device", "a pipe", "too long"])
def test_what_is_no_regular_file_or_too_long_is_an_error_and_is_not_read(tmp_path, what):
    shutil.copytree(POLICIES, tmp_path, dirs_exist_ok=True)
    for path in (tmp_path / "profiles" / "new.yaml", tmp_path / "tests" / "new.yaml"):
        if what == "a device":
            path.symlink_to("/dev/null")  # as good as one that never ends
        elif what == "a pipe":
            os.mkfifo(path)
        else:
            path.write_text("#" * (bundle.MOST_BYTES + 1))
    valid = "cannot be read: valid is a regular file of at most 32,000,000 bytes"
    for read, file in ((bundle.load, "profiles/new.yaml"), (bundle.read_cases, "tests/new.yaml")):
        with pytest.raises(PolicyErrors) as found:
            read(tmp_path)
        assert [(problem.file, problem.message) for problem in found.value.problems] == [(file, valid)]


def test_a_file_may_be_long_and_a_link(tmp_path):
    shutil.copytree(POLICIES, tmp_path / "policies")
    site = tmp_path / "policies" / SITE
    text = site.read_text()
    (tmp_path / "kept.yaml").write_text(text + "#" * (bundle.MOST_BYTES - len(text.encode())))
    site.unlink()
    site.symlink_to(tmp_path / "kept.yaml")
    assert bundle.load(tmp_path / "policies").site == shipped().site


@pytest.mark.parametrize(("read", "folder"), [(bundle.load, "capabilities"), (bundle.read_cases, "tests")])
def test_a_folder_that_is_a_link_is_said_not_to_be_followed(tmp_path, read, folder):
    shutil.copytree(POLICIES, tmp_path / "policies")
    (tmp_path / "policies" / folder).rename(tmp_path / "elsewhere")
    (tmp_path / "policies" / folder).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(PolicyErrors) as found:
        read(tmp_path / "policies")
    said = "is a link to a directory, and such a link is not followed: valid is a directory of its own"
    assert [(problem.file, problem.message) for problem in found.value.problems] == [(folder, said)]


def test_the_same_files_make_the_same_digest_and_another_byte_another():
    assert bundle.load_files(dict(reversed(files().items()))).digest == shipped().digest
    changed = {**files(), H: files()[H] + "\n"}
    assert bundle.digest(changed) != shipped().digest


def test_what_is_promised_is_read_beside_the_policy_and_no_part_of_it(tmp_path):
    assert "order:" in (bundle.read_properties(POLICIES) or "")
    assert "properties.yaml" not in bundle.read_files(POLICIES)
    assert bundle.read_properties(tmp_path) is None
