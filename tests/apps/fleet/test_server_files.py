"""Files for NATS servers: what is in them, and what is not."""

import re

import pytest

from busway.apps.fleet.server_files import (
    NatsServer,
    NatsServerOptions,
    accounts_text,
    leafs_text,
    server_text,
    site_secret_text,
    site_text,
)
from busway.apps.fleet.server_rights import RIGHTS, permissions, rights_table

KEYS = {"collector": "UC", "sink": "US", "operator": "UO"}
THREE = [NatsServer(f"n{number}", f"10.0.0.{number}") for number in (1, 2, 3)]


def test_one_server_has_no_cluster_and_no_secret() -> None:
    text = server_text(THREE[0], THREE[:1], NatsServerOptions())
    assert text == (
        "# nats-server 2.9, made by busway fleet server-config. No secrets.\n"
        'server_name: "n1"\nlisten: "10.0.0.1:4222"\njetstream {\n  store_dir: "/var/lib/nats/n1"\n}\n'
        'tls {\n  cert_file: "/etc/nats/tls/n1.pem"\n  key_file: "/etc/nats/tls/n1.key"\n'
        '  ca_file: "/etc/nats/tls/ca.pem"\n}\ninclude "./accounts.conf"\n'
    )


def test_servers_of_a_cluster_know_each_other_and_have_certificates_for_it() -> None:
    text = server_text(THREE[1], THREE, NatsServerOptions())
    assert 'routes: ["nats://10.0.0.1:6222", "nats://10.0.0.2:6222", "nats://10.0.0.3:6222"]' in text
    assert text.count("cert_file") == 2
    assert "tls" not in server_text(THREE[1], THREE, NatsServerOptions(tls=None))


@pytest.mark.parametrize(("version", "count"), [((2, 9), 0), ((2, 10), 1), ((2, 12), 1)])
def test_the_word_that_2_9_refuses_is_for_newer_servers(version: tuple[int, int], count: int) -> None:
    text = server_text(THREE[0], THREE, NatsServerOptions(version))
    assert text.count("sync_interval: always") == count


def test_a_path_with_quotes_stays_one_text() -> None:
    assert r'store_dir: "/a\"b\\c/n1"' in server_text(THREE[0], THREE[:1], NatsServerOptions(store='/a"b\\c'))


def test_each_zone_has_an_account_with_one_user_for_each_role() -> None:
    text = accounts_text({"hall": KEYS, "yard": KEYS}, "USTATUS")
    assert re.findall(r'"(zone-\w+)"', text) == ["zone-hall", "zone-yard"]
    assert (text.count("nkey: "), text.count("nkey: UC"), text.count("allow_responses")) == (7, 2, 2)
    hall, yard = text.split('"zone-yard"')
    assert "yard" not in hall
    assert "hall" not in yard


def test_no_role_may_delete_purge_or_change_streams_and_only_operators_make_them() -> None:
    for role in RIGHTS:
        granted = permissions(role, "hall")
        text = " ".join(granted.publish)
        assert not re.search(r"DELETE|PURGE|UPDATE|RESTORE|SNAPSHOT|\$JS\.API\.>", text)
        assert ("STREAM.CREATE" in text) == (role == "operator")
        assert ">" not in (*granted.publish, *granted.subscribe)
        for other in ("lease", "control", "cursor"):
            owner = {"lease": "collector", "control": "operator", "cursor": "sink"}[other]
            assert (f"$KV.busway-hall.{other}" in text) == (role == owner)


@pytest.mark.parametrize("is_site", [False, True])
def test_no_role_may_get_an_entry_of_a_table_from_a_server_that_does_not_lead(is_site: bool) -> None:
    """All read tables as consumers; the newest message of samples is got for the lag of sinks alone."""
    for role in RIGHTS:
        got = [subject for subject in permissions(role, "hall", is_site=is_site).publish if ".GET" in subject]
        assert not [subject for subject in got if "DIRECT" in subject or "KV_" in subject]
        assert all("STREAM.MSG.GET.busway-samples-hall" in subject for subject in got)


def test_the_table_has_a_row_for_each_right() -> None:
    assert len(rights_table("hall").splitlines()) == 2 + sum(map(len, RIGHTS.values())) + 1


def test_a_site_is_a_domain_and_knows_the_centre_by_a_password_in_a_file_of_its_own() -> None:
    site = NatsServer("yard", "10.7.0.1")
    text = site_text(site, NatsServerOptions())
    assert 'domain: "yard"' in text
    assert 'include "./yard-leaf.conf"\ninclude "./yard-accounts.conf"' in text
    secret = site_secret_text(site, THREE[:2], NatsServerOptions(), "pass")
    assert 'urls: ["tls://yard:pass@10.0.0.1:7422", "tls://yard:pass@10.0.0.2:7422"], account: "zone-yard"' in secret
    assert '{ user: "yard", password: "pass", account: "zone-yard" }' in leafs_text({"yard": "pass"})
    centre = server_text(THREE[0], THREE, NatsServerOptions(), has_sites=True)
    assert ('listen: "10.0.0.1:7422"' in centre, "pass" in centre) == (True, False)


def test_at_the_centre_rights_to_the_table_of_a_site_are_those_of_its_domain() -> None:
    granted = permissions("sink", "yard", is_site=True).publish
    assert "$JS.yard.API.$KV.busway-yard.cursor.*" in granted
    assert "$JS.yard.API.STREAM.INFO.KV_busway-yard" in granted
    assert not [subject for subject in granted if "control" in subject]
